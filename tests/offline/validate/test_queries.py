"""Random queries: within range, on the surface, and like a tool that moves."""

import numpy as np
import pytest

from palpate.offline.validate.compare import play
from palpate.offline.validate.queries import held_out_loads, random_histories
from palpate.shared.mechanics.footprint import pressure_limit


def test_loads_reach_the_ends_and_the_full_tilt(visco_atlas):
    loads = held_out_loads(visco_atlas, 64, 0)
    x = np.array([load.position for load in loads])
    assert (np.ptp(x[:, :2], axis=0) > 9.9).all()
    tilt = [np.degrees(np.arccos(-load.direction[2])) for load in loads]
    assert max(tilt) == pytest.approx(30.0)


def test_histories_stay_in_range_and_on_the_surface(visco_atlas):
    slid = 0.0
    for history in random_histories(visco_atlas, 20, np.random.default_rng(0)):
        for load in history:
            _, normal, distance, fields = visco_atlas.surface.locate(
                load.position, visco_atlas.limits
            )
            assert distance == pytest.approx(0.0, abs=1e-9)
            assert load.dt > 0.0
            assert 0.0 <= load.pressure <= 1.001 * pressure_limit(fields, normal, load.direction)
            tilt = np.degrees(np.arccos(np.clip(-load.direction @ normal, -1, 1)))
            assert tilt <= visco_atlas.scene.endoscope.max_tilt + 1e-6
        steps = np.diff([load.position for load in history], axis=0)
        slid = max(slid, np.linalg.norm(steps, axis=1).sum())
    assert slid > 5.0


def test_histories_of_the_tip_move_like_a_tool(visco_atlas, rng):
    histories = random_histories(visco_atlas, 8, rng, tip=True)
    for history in histories:
        assert min(step.dt for step in history) > 0.0
        answers = play(visco_atlas, history)
        assert all(answer.converged and answer.in_range for answer in answers)
        assert any(answer.contact for answer in answers)
    assert len({tuple(history[0].position) for history in histories}) == 8
