"""Errors of answers, and what is said of many."""

import numpy as np
import pytest

from palpate.offline.fem.norms import relative
from palpate.offline.fem.problem import Reference
from palpate.offline.validate.compare import Compared, KnownAnswer, compare, flags, play, summarise
from palpate.offline.validate.queries import TIP_HISTORIES, random_histories
from palpate.shared.scene import Tolerance


def test_errors_are_relative_and_of_moments_to_the_largest_so_far():
    assert relative(np.array([3.0, 1.0]), np.array([3.0, 0.0])) == pytest.approx(1 / 3)
    assert relative(np.ones(3), np.zeros(3)) == 0.0
    exact = np.array([[1.0, 0.0], [4.0, 0.0], [0.0, 0.0]])
    found = exact + np.array([[0.1, 0.0], [0.0, 0.2], [0.4, 0.0]])
    compared = Compared(found, exact, np.ones(2))
    np.testing.assert_allclose(compared.so_far, [0.1, 0.05, 0.1])
    assert compared.error == pytest.approx(relative(found, exact))
    np.testing.assert_allclose(Compared(found, exact, np.array([1.0, 4.0])).away, [0.1, 0.4, 0.4])


def test_moments_in_different_equilibria_are_told_apart(visco_atlas, visco_problem, rng):
    (history,) = random_histories(visco_atlas, 1, rng, tip=True)
    answers = play(visco_atlas, history)
    fields = (visco_atlas.displacement, visco_atlas.von_mises)
    u, stress = (np.array([field(answer) for answer in answers]) for field in fields)
    forces, tangents = zip(*((answer.force, answer.tangent) for answer in answers), strict=True)
    at = np.argmax(np.linalg.norm(u.reshape(len(u), -1), axis=1))
    u[at] *= 1.2  # as if it had gone further there
    full = Reference(u, stress, np.array(forces), np.array(tangents))
    row = compare(TIP_HISTORIES, visco_problem, visco_atlas, history, full)
    assert row.table["apart"] == 1
    assert row.table["displacement"] > 0.01
    assert row.table["together_displacement"] <= 1e-6
    found = summarise(TIP_HISTORIES, [row], visco_atlas.scene.tolerance)
    assert found["apart"] == {"histories": 1, "moments": 1}
    assert found["together_displacement"]["max"] <= 1e-6 < found["displacement"]["max"]


def answered(errors, estimated, mesh):
    return KnownAnswer(
        np.array(errors), np.ones(1), True, True, False, np.array(mesh), np.array(estimated)
    )


def test_right_answers_that_are_doubted_are_counted_and_what_is_to_blame():
    right, wrong, small, large = (0.009, 0.01), (0.03, 0.01), (0.01, 0.02), (0.029, 0.02)
    known = [
        answered(right, small, (0.02, 0.1)),  # trusted: .022 and .102
        answered(right, large, (0.02, 0.1)),  # .035 of displacement, mostly the reduction's
        answered(right, small, (0.02, 0.2)),  # the mesh alone is beyond the tolerance
        answered(right, small, (0.02, 0.2)),
        answered(right, small, (0.02, 0.2)),
        answered(wrong, large, (0.02, 0.1)),  # is no right one
        answered(right, (np.inf, np.inf), (0.02, 0.1)),  # out of range
    ]
    found = flags(known, Tolerance())
    assert found == {"share": 0.5, "right": 2, "mostly": "the mesh's von_mises"}
    assert flags(known[:2], Tolerance())["mostly"] == "the reduction's displacement"
    assert flags(known[:1], Tolerance()) == {"share": 0.0, "right": 1, "mostly": None}
