import numpy as np

from palpate.offline import bench as timing
from palpate.offline.bench import STEP, walk
from palpate.offline.validate.queries import held_out_loads

KINDS = ["cold_us", "warm_us", "surface_us", "fields_us", "full_us", "tip_us"]


def test_every_kind_of_query_is_timed(answer, artifact, monkeypatch):
    monkeypatch.setattr(timing, "ROUNDS", 3)
    monkeypatch.setattr(timing, "QUERIES", 30)
    report = answer("bench", artifact)
    assert list(report) == [*KINDS, "p95", "ratio"]
    assert list(report["p95"]) == KINDS
    assert all(0 < report[kind] <= report["p95"][kind] for kind in KINDS)
    assert report["ratio"] == report["full_us"] / report["cold_us"]


def test_a_walk_stays_on_the_surface_and_in_range(atlas, rng):
    for start in held_out_loads(atlas, 5, 0):
        loads = walk(atlas, start, 300, rng)
        assert len(loads) == 300
        positions = np.array([load.position for load in loads])
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        assert (steps <= STEP * (1 + 1e-9)).all()
        assert (steps >= 0.9 * STEP).all()
        for load in loads[::20]:
            solution = atlas.press(load.position, load.pressure, load.direction)
            assert solution.distance < 1e-9
            assert solution.in_range
