"""Many queries on many threads: what each is answered by itself."""

import numpy as np
import pytest

from palpate.offline.reduce.sampling import cone
from palpate.shared import many
from palpate.shared.errors import QueryError

SOLVED = ("converged", "iterations", "min_jacobian", "contact_displacement")
FELT = ("contact_point", "normal", "force")  # under a tip they are solved for, too
TOLD = ("distance", "in_range", "error_displacement", "error_von_mises", "error_force")


@pytest.fixture(autouse=True)
def small_parts(monkeypatch):
    monkeypatch.setattr(many, "PART", 7)


@pytest.fixture
def loads(atlas, rng):
    """Positions, pressures, some beyond the limit, and directions, some beyond the range."""
    at = rng.choice(atlas.surface.vertices, 60) + rng.normal(0.0, 0.05, (60, 3))
    normals = np.array([atlas.surface.project(x)[1] for x in at])
    towards = np.array([cone(normal, 35.0, 1, rng)[0] for normal in normals])
    return at, rng.uniform(0.0, 1.1, 60) * atlas.pressure_max, 3.0 * towards


def assert_same(answers, others):
    """But for round-off, by which two compilations of a kernel may differ.

    Beyond the range tissue folds, and round-off decides how.  Of a tip that does not touch nobody
    asks for the contact.
    """
    tip = others[0].tip
    sought = np.array([answer.contact or not tip for answer in others])
    for name in SOLVED + FELT + TOLD:
        one, other = getattr(answers, name), np.array([getattr(answer, name) for answer in others])
        solved = name in SOLVED or (tip and name in FELT)
        kept = answers.in_range if solved else np.ones_like(sought)
        if name in ("contact_point", "normal"):
            kept = kept & sought
        np.testing.assert_allclose(one[kept], other[kept], rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("threads", [1, 3])
def test_loads_are_answered_as_one_by_one(atlas, loads, threads):
    answers = atlas.solve_many(*loads, threads=threads)
    assert_same(answers, [atlas.press(*load) for load in zip(*loads, strict=True)])
    assert 0 < answers.in_range.sum() < 60
    at, pressures, _ = loads
    along = atlas.solve_many(at, pressures, threads=threads)
    assert_same(along, [atlas.press(*load) for load in zip(at, pressures, strict=True)])


@pytest.mark.parametrize("threads", [1, 3])
def test_positions_of_the_tip_are_answered_as_one_by_one(atlas, rng, threads):
    """In, out and beside."""
    x = rng.choice(atlas.surface.vertices, 60)
    x = x + rng.uniform(-0.3, 0.3, (60, 3)) + [0.0, 0.0, 1.0] * rng.uniform(0.5, 2.2, (60, 1))
    answers = atlas.touch_many(x, threads=threads)
    assert_same(answers, [atlas.touch(position) for position in x])
    assert 0 < (answers.force[:, 2] > 0.0).sum() < 60


def test_none_are_none(atlas):
    assert len(atlas.solve_many(np.empty((0, 3)), []).force) == 0


WRONG = {
    "positions.1": {"positions": [[5, 5, 8], [5, np.nan, 8]]},
    "positions": {"positions": [[5, 5], [5, 5]]},
    "positions.0": {"positions": [[5, 5, 80], [5, 5, 8]]},
    "positions.1, too large to be squared": {"positions": [[5, 5, 8], 3 * [1.7e308]]},
    "pressures.1": {"pressures": [1.0, -1.0]},
    "pressures": {"pressures": [1.0]},
    "directions.0": {"directions": [[0, 0, 1], [0, 0, -1]]},
    "directions.1": {"directions": [[0, 0, -1], [0, 0, 0]]},
}


@pytest.mark.parametrize(("field", "changes"), WRONG.items(), ids=WRONG)
def test_the_row_that_is_wrong_is_named(atlas, field, changes):
    loads = {"positions": [[5, 5, 8], [5, 6, 8]], "pressures": [1.0, 1.0]} | changes
    with pytest.raises(QueryError) as refused:
        atlas.solve_many(**loads)
    assert refused.value.field == field.partition(",")[0]


def test_directions_may_be_as_large_as_numbers_are(atlas):
    """Nor does the direction of one change with its length."""
    at, along = np.array([[5.0, 5.0, 8.0]]), np.array([[0.9, 0.8, -1.0]])
    usual, large = (atlas.solve_many(at, [1.0], scale * along) for scale in (1.0, 1.79e308))
    np.testing.assert_allclose(large.force, usual.force, rtol=1e-12)


def test_a_tip_below_the_surface_is_named(atlas):
    with pytest.raises(QueryError) as refused:
        atlas.touch_many([[5, 5, 9.8], [5, 5, 7.0]])
    assert refused.value.field == "positions.1"
