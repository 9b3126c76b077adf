"""The smallest size that meets a tolerance, and what is said when none does."""

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.offline.choose.size import LADDER, RUNG, Trial, TrialResult, choose, ladder, try_patch
from palpate.offline.reduce.layout import Layout
from palpate.offline.reduce.sampling import fewer
from palpate.offline.validate.compare import KnownAnswer
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, TIP_DEPTH
from palpate.shared.mechanics.neo_hookean import NeoHookeanTissue
from palpate.shared.scene import Budget, Size, Tolerance

BUDGET = Budget(query=150e-6)
TOLERANCE = Tolerance(displacement=0.03, von_mises=0.12)  # 1 and 2 % of the reduction
PLACES = range(len(LADDER))


def result(displacement, von_mises, seconds=1e-4):
    """A trial's answers of given errors, which go with nothing that is known of them."""
    pairs = np.column_stack([displacement, von_mises])
    return TrialResult([KnownAnswer(e, np.ones(2), True, True) for e in pairs], seconds)


def chosen(errors, tolerance=TOLERANCE, slower=0.0):
    """Choice among trials whose errors are given size by size, and the sizes tried, in order."""
    tried = []

    def attempt(size):
        place = LADDER.index(size)
        tried.append(place)
        error = np.full(20, errors[place])
        return Trial.of(size, [result(error, 2 * error, 50e-6 + slower * place)])

    return choose(LADDER, tolerance, BUDGET, attempt), tried


@pytest.mark.parametrize("smallest", PLACES)
@pytest.mark.parametrize(
    ("errors", "most"),
    [
        (lambda k: 0.0095 * RUNG**k, 3),  # as sizes are expected to differ
        (lambda k: 0.02 if k < 0 else 0.009, len(LADDER)),
        (lambda k: 1.0 if k < 0 else 0.0, len(LADDER)),
    ],
)
def test_the_smallest_size_that_is_good_enough(smallest, errors, most):
    (size, document), tried = chosen([errors(i - smallest) for i in PLACES])
    assert size == LADDER[smallest]
    assert len(tried) == len(set(tried)) <= most
    assert document["why"].startswith("the smallest")
    assert [Size(**trial["size"]) for trial in document["tried"]] == [
        LADDER[place] for place in sorted(tried)
    ]


@pytest.mark.parametrize(("allowed", "place"), [(0.01, 3), (0.02, 1), (0.05, 0)])
def test_a_looser_tolerance_takes_a_smaller_model(allowed, place):
    tolerance = Tolerance(displacement=3 * allowed, von_mises=12 * allowed)
    assert chosen([0.03, 0.015, 0.01, 0.006, 0.004], tolerance)[0][0] == LADDER[place]
    if place == 0:  # and pays for no trial of a large one
        assert chosen([0.03 * RUNG**i for i in PLACES], tolerance)[1] == [0]


def test_a_tolerance_out_of_reach_is_said_plainly():
    (size, document), _ = chosen([0.5, 0.4, 0.3, 0.2, 0.1])
    assert size == LADDER[-1]
    assert (
        "no size's estimates are within the reduction's share of 1.00% and 2.00%" in document["why"]
    )
    assert "10.00% displacement, 20.00% von Mises" in document["why"]


def test_a_budget_exceeded_names_the_best_within_it():
    (size, document), _ = chosen([0.5, 0.4, 0.3, 0.005, 0.004], slower=45e-6)
    assert size == LADDER[3]
    assert "185 µs to solve, over the budget of 150 µs" in document["why"]
    assert "the best within it" in document["why"]
    assert "30.00% displacement, 60.00% von Mises" in document["why"]


def test_what_would_be_estimated_counts_and_not_the_errors(rng):
    """Errors that scatter are estimated at what the worst of them are."""
    scattered = 0.01 * np.exp(0.5 * rng.standard_normal(70) - 1.0)
    trial = Trial.of(LADDER[0], [result(scattered, scattered)])
    assert trial.displacement["p95"] < 0.01
    assert trial.over(TOLERANCE) > 1.0
    # the same errors, but known beforehand
    known = [
        KnownAnswer(np.full(2, error), np.array([1.0, np.log(error)]), True, True)
        for error in scattered
    ]
    assert Trial.of(LADDER[0], [TrialResult(known, 1e-4)]).over(TOLERANCE) < 1.0


def test_a_load_without_an_answer_rules_a_size_out():
    good, other = (result(np.full(9, 0.001), np.full(9, 0.001)) for _ in range(2))
    other.known[3].converged = False
    assert Trial.of(LADDER[0], [good, good]).over(TOLERANCE) <= 1.0
    assert Trial.of(LADDER[0], [other, other]).over(TOLERANCE) > 10.0


def test_a_looser_tolerance_is_served_by_fewer_samples():
    loose = Tolerance(displacement=0.12, von_mises=0.6)
    tight = Tolerance(displacement=0.003, von_mises=0.12)
    assert [fewer(300, tolerance) for tolerance in (TOLERANCE, loose, tight)] == [300, 150, 300]
    assert fewer(1, loose) == 1


def scene(poisson, radius=1.0):
    tissue = NeoHookeanTissue(law="neo-hookean", young=15.0, poisson=poisson)
    return SimpleNamespace(tissue=tissue, endoscope=SimpleNamespace(radius=radius))


def test_patches_are_as_far_apart_as_the_endoscope_is_large():
    one, three = ladder(scene(0.45)), ladder(scene(0.45, radius=3.0))
    for small, large in zip(one, three, strict=True):
        assert large.patch_spacing == pytest.approx(3.0 * small.patch_spacing)
        assert large.modes == small.modes


def test_the_less_compressible_the_more_points():
    sizes = [ladder(scene(p)) for p in (0.3, 0.45, 0.49, 0.499)]
    assert sizes[0] == sizes[1] == LADDER
    for own in zip(*sizes[1:], strict=True):
        assert len({size.modes for size in own}) == 1
        points = np.array([size.cubature_points for size in own])
        np.testing.assert_allclose(points[1:] / points[0], [1.76, 3.81], rtol=0.2)


@pytest.mark.parametrize("name", ["problem", "tetrahedra"])
def test_a_patch_that_is_tried_answers_for_loads_it_has_not_seen(name, request):
    """Of hexahedra, and of tetrahedra whose law is integrated in two parts."""
    problem, middle = request.getfixturevalue(name), np.array([5.0, 5.0, 8.0])
    nodal, normal = problem.unit_load(middle)
    pressed = problem.model.solve_linear(np.outer(-nodal, normal).ravel()[problem.model.free])
    u = problem.model.filled(pressed).reshape(-1, 3)
    compliance = -problem.under(middle, u) @ normal  # mm/kPa
    fields = np.zeros(LIMIT_FIELDS)
    fields[0], fields[1:4], fields[TIP_DEPTH] = 0.5 / compliance, compliance, 0.5
    limits = np.tile(fields, (len(problem.surface.vertices), 1))
    size = problem.scene.training.size
    layout = Layout(problem.scene, problem.surface, limits, size)
    central = int(np.linalg.norm(layout.centres - middle, axis=1).argmin())
    found = try_patch(problem, layout.patch(central), limits)
    errors = np.array([answer.errors for answer in found.known])
    print(f"{name}: displacement {errors[:, 0].mean():.2%}, von Mises {errors[:, 1].mean():.2%}")
    assert found.given_way == 0
    assert (errors.mean(axis=0) < 0.03).all()
