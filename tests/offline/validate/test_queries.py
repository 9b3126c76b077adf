"""Random queries: within range, on the surface, and like a tool that moves."""

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.fem.problem import FullProblem
from palpate.offline.scenes import find_scene
from palpate.offline.validate.compare import play
from palpate.offline.validate.queries import (
    Place,
    held_out_loads,
    random_histories,
    random_positions,
)
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, TIP_DEPTH, pressure_limit


def test_loads_reach_the_ends_and_the_full_tilt(visco_atlas):
    loads = held_out_loads(visco_atlas, 64, 0)
    x = np.array([load.position for load in loads])
    assert (np.ptp(x[:, :2], axis=0) > 9.9).all()
    tilt = [np.degrees(np.arccos(-load.direction[2])) for load in loads]
    assert max(tilt) == pytest.approx(30.0)


def test_positions_of_the_tip_are_in_range_in_a_cleft_too(rng):
    """Where one side of it is touched a little, the other can be touched deep."""
    problem, most = FullProblem(find_scene("turbinate-mri")), 0.3
    limits = np.ones((len(problem.surface.vertices), LIMIT_FIELDS))
    limits[:, TIP_DEPTH] = most
    model = SimpleNamespace(surface=problem.surface, limits=limits, scene=problem.scene)

    def depths(steps):
        heights = [model.surface.height(step.position) for step in steps]
        return model.scene.endoscope.radius - np.array(heights)

    anywhere = [Place.at(model, x).touch(1.0) for x in problem.surface.vertices]
    found = depths(random_positions(model, 200, rng))
    assert depths(anywhere).max() > 1.5 * most
    assert len(found) == 200
    assert 0.9 * most < found.max() <= most


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
