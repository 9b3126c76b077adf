"""The local models: mechanics of the full model in few modes, and answers that are continuous."""

from dataclasses import replace

import numpy as np
import pytest
from numba import njit

from palpate.offline.fem.problem import FullProblem, Load
from palpate.offline.reduce.footprint_models import LocalTrainer
from palpate.shared.artifact import read_artifact
from palpate.shared.mechanics import newton
from palpate.shared.model import ReducedModel
from palpate.shared.reduced.corrections import forget_secants
from palpate.shared.reduced.outcome import PRESS_FEATURES
from palpate.shared.reduced.press import (
    ROUND_OFF,
    TOLERANCE,
    local_problem,
    place,
    press,
)
from palpate.shared.reduced.problem import descend
from palpate.shared.reduced.terms import Elastic
from palpate.shared.reduced.workspace import press_workspace
from palpate.shared.scene import Tolerance
from palpate.shared.tables import press_models


@pytest.fixture(scope="module")
def atlas(artifact):
    return ReducedModel.load(artifact)


@pytest.fixture(scope="module")
def problem(artifact):
    return FullProblem.of_artifact(read_artifact(artifact))


@pytest.fixture(scope="module")
def galerkin(atlas, problem):
    """Return the first local model with every quadrature point and its own weight."""
    models, region = atlas.models, atlas.models.region[0]
    weights = problem.model.weights.ravel()
    return replace(
        models,
        basis=models.basis[[region]],
        steps=models.steps[[region]],
        region=np.zeros(1, np.int32),
        centres=models.centres[:1],
        frames=models.frames[:1],
        pressures=models.pressures[:1],
        whole=models.whole[:1],
        mix=models.mix[:1],
        point_from=np.array([0, len(weights)]),
        points=np.arange(len(weights), dtype=np.int32),
        weights=weights,
        defect=np.zeros_like(models.defect[:1]),
        guess=models.guess[:1],
        directions=models.directions[:1],
        change=models.change[:1],
    )


@pytest.fixture(scope="module")
def single(atlas, galerkin):
    """Return the first local model as it is."""
    models = atlas.models
    own = slice(models.point_from[0], models.point_from[1])
    return replace(
        galerkin,
        point_from=np.array([0, own.stop - own.start]),
        points=models.points[own],
        weights=models.weights[own],
        defect=models.defect[:1],
    )


@pytest.fixture(scope="module")
def modes(galerkin):
    """Return the modes as nodal displacements (3 n, r)."""
    in_basis = galerkin.steps[0][:, None].astype(float) * galerkin.modes[0]
    return galerkin.basis[0].T.astype(float) @ in_basis


def alone(atlas, models, scene=None):
    """Return the workspace of a local model by itself."""
    scene = scene or atlas.scene
    return press_workspace(
        press_models(atlas.body, models, scene), atlas.surface.ground(atlas.limits),
        scene.endoscope.max_tilt, np.zeros((2, PRESS_FEATURES)), Elastic(),
    )  # fmt: skip


def problem_of(own, k=0, load=0.0):
    """Local model k under a load (r,), its tangent that at rest."""
    own.scratch.load[:] = load
    own.scratch.external[:] = load
    forget_secants(own.warm.inverse[0], own.warm.origin[0])
    return local_problem(own.solver, k, 0)


@pytest.fixture(scope="module")
def unloaded(atlas, galerkin):
    """Return the first local model with every point, without a load."""
    return problem_of(alone(atlas, galerkin))


@njit
def potential(problem, q, residual):
    return newton.potential(problem, q, residual)


@njit
def correct(problem, residual, step):
    newton.correct(problem, residual, step)


@njit
def solve(problem, q, work, target):
    energy, smallest = newton.potential(problem, q, work[0])
    return descend(problem, q, work, energy, smallest, target, np.inf, 200, True, ROUND_OFF)[0]


def norm(vector):
    return float(np.linalg.norm(vector))


def residual_of(problem, q):
    residual = np.empty(len(q))
    potential(problem, q, residual)
    return residual


@pytest.fixture
def state(modes, rng):
    """Return coefficients (r,) whose displacement is of 1 mm."""
    q = rng.standard_normal(modes.shape[1]) / np.arange(1, modes.shape[1] + 1)
    return q / np.abs(modes @ q).max()


# --- one physics, two sizes ----------------------------------------------------------------------


def test_with_every_point_it_is_the_full_model_in_its_modes(unloaded, modes, problem, state):
    residual, force = np.empty(len(state)), np.empty(len(modes))
    energy, smallest = potential(unloaded, state, residual)
    expected_energy, expected_smallest = problem.model.internal(modes @ state, force)
    expected = modes.T @ force
    # modes are stored in half precision, their gradients in 16 bits
    assert energy == pytest.approx(expected_energy, rel=1e-3)
    assert smallest == pytest.approx(expected_smallest, rel=1e-3)
    assert np.linalg.norm(residual - expected) <= 1e-3 * np.linalg.norm(expected)


def test_its_modes_are_orthonormal_in_the_energy_at_rest(modes, problem):
    free = modes[problem.model.free]
    gram = free.T @ (problem.model.rest_stiffness @ free)
    # modes are stored in half precision
    np.testing.assert_allclose(gram, np.eye(len(gram)), atol=2e-3)


def derivative(function, u, directions, step=2e-2):
    """Of fourth order, along each direction; gradients are summed in single precision."""
    slopes = []
    for unit in step * directions:
        near = function(u + unit) - function(u - unit)
        far = function(u + 2 * unit) - function(u - 2 * unit)
        slopes.append((8 * near - far) / (12 * step))
    return np.array(slopes)


def test_residual_is_the_derivative_of_the_potential(unloaded, state):
    scratch = np.empty(len(state))
    slopes = derivative(lambda q: potential(unloaded, q, scratch)[0], state, np.eye(len(state)))
    expected = residual_of(unloaded, state)
    assert np.abs(slopes - expected).max() <= 1e-4 * np.abs(expected).max()


def test_tangent_is_the_derivative_of_the_residual(unloaded, galerkin, problem, state):
    trainer = LocalTrainer(problem, galerkin)
    K = np.eye(len(state)) + trainer.tangent_changes(state[None])[0]
    found = derivative(lambda q: residual_of(unloaded, q), state, np.eye(len(state)))
    assert np.abs(found - K).max() <= 1e-4 * np.abs(K).max()


def test_a_secant_is_what_the_inverse_tangent_answers_from_then_on(atlas, single, rng):
    own = alone(atlas, single)
    inverse, latest, r = own.warm.inverse[0], own.scratch.work.latest, len(own.scratch.load)
    K, load = np.diag(rng.uniform(0.5, 2.0, r)), rng.standard_normal(r)
    problem, states, correction = problem_of(own, load=load), rng.standard_normal((3, r)), load * 0
    for state in states:
        latest[:] = state
        correct(problem, K @ state - load, correction)
    step = states[-1] - states[-2]
    np.testing.assert_allclose(inverse @ K @ step, step, atol=1e-12)
    np.testing.assert_allclose(inverse, inverse.T, atol=1e-12)
    np.testing.assert_allclose(correction, -inverse @ (K @ states[-1] - load), atol=1e-12)
    assert np.linalg.eigvalsh(inverse)[0] > 0.0


# --- answers -------------------------------------------------------------------------------------


def test_points_and_defect_together_answer_as_all_points(atlas, problem, galerkin, single):
    few = replace(single, defect=galerkin.defect)
    trainers = [LocalTrainer(problem, local) for local in (galerkin, few, single)]
    centre, inward = single.centres[0], -single.frames[0, 0]
    limit = atlas.press(centre, 1.0).pressure_limit
    errors = []
    for share in np.linspace(0.3, 1.0, 8):
        samples = [trainer.solve(centre, inward, share * limit) for trainer in trainers]
        exact, *others = (sample.q for sample in samples)
        errors.append([norm(q - exact) / norm(exact) for q in others])
    without, fitted = np.mean(errors, axis=0)
    assert fitted < 0.5 * without


def test_beyond_the_range_the_defect_stays_what_it_is_at_its_end(atlas):
    centre = atlas.models.centres[0]
    limit = atlas.press(centre, 1.0).pressure_limit

    def load(share):
        warm = atlas.new_warm()
        assert len(atlas.press(centre, share * limit, warm=warm).parts) == 1
        return warm.press(in_time=False).scratch.load.copy()

    def bend(*shares):
        first, middle, last = (load(share) for share in shares)
        return norm(first - 2 * middle + last) / norm(last)

    assert bend(1.0, 1.25, 1.5) < 1e-6
    assert bend(0.5, 0.75, 1.0) > 1e-5


def pressed(own, position, pressure, radius=2.0):
    """Press towards the inside, independently of the last load; iterations and answer (r,)."""
    own.forget()
    place(own.solver, position, np.zeros(3))
    press(own.solver, pressure, radius)
    assert own.outcome.status.item() == newton.CONVERGED
    return own.outcome.iterations.item(), own.warm.q[0].copy()


def test_first_guess_and_first_tangent_each_save_iterations(atlas, single):
    without_tangent = replace(single, change=np.zeros_like(single.change))
    without_guess = replace(without_tangent, guess=np.zeros_like(single.guess))
    x, found = single.centres[0], []
    limit = atlas.press(x, 1.0).pressure_limit
    for models in (single, without_tangent, without_guess):
        own = alone(atlas, models)
        found.append(sum(pressed(own, x, share * limit)[0] for share in np.linspace(0.3, 1.0, 8)))
    assert found[0] < 0.8 * found[1] < 0.8 * found[2]


@pytest.mark.parametrize("wrong", ["guess", "change"])
def test_where_the_start_is_no_good_the_answer_is_found_from_rest(atlas, single, wrong):
    far = {"guess": 100.0 * single.guess, "change": -100.0 * np.abs(single.change)}[wrong]
    x = single.centres[0]
    limit = atlas.press(x, 1.0).pressure_limit
    expected = pressed(alone(atlas, single), x, limit)[1]
    iterations, found = pressed(alone(atlas, replace(single, **{wrong: far})), x, limit)
    assert iterations > 4
    assert norm(found - expected) <= 4 * TOLERANCE * norm(expected)


@pytest.fixture(scope="module")
def border(atlas):
    """Return two neighbouring centres and the contact pressure used between them."""
    centres = atlas.models.centres
    inside = np.argsort(np.linalg.norm(centres - centres.mean(axis=0), axis=1))
    first = inside[0]
    second = np.argsort(np.linalg.norm(centres - centres[first], axis=1))[1]
    limit = atlas.press(centres[first], 1.0).pressure_limit
    return centres[first], centres[second], 0.8 * limit


def test_cold_answers_repeat_to_the_bit(atlas, border):
    first, second, pressure = border
    x = 0.5 * (first + second)
    once = atlas.press(x, pressure)
    atlas.press(first, 0.3 * pressure)
    again = atlas.press(x, pressure)
    assert [k for k, _, _ in once.parts] == [k for k, _, _ in again.parts]
    np.testing.assert_array_equal(once.contact_displacement, again.contact_displacement)
    np.testing.assert_array_equal(atlas.displacement(once), atlas.displacement(again))


def test_a_warm_answer_is_the_equilibrium_of_its_patch(atlas, border):
    first, second, pressure = border
    memory, own, followed = atlas.new_warm(), atlas.workspace(tip=False, in_time=False), 0
    for share in np.linspace(0.0, 0.25, 12):
        x, force = first + share * (second - first), (0.5 + share) * pressure
        parts = atlas.press(x, force, warm=memory).parts
        if len(parts) > 1 or share == 0.0:
            continue
        k, _, warm = parts[0]
        load = memory.press(in_time=False).scratch.load
        problem = problem_of(own, k, load)
        assert norm(residual_of(problem, warm)) <= 1.02 * TOLERANCE * norm(load)
        exact, work = warm.copy(), np.empty((4, len(warm)))
        assert solve(problem, exact, work, 1e-5 * norm(load)) == newton.CONVERGED
        assert norm(warm - exact) <= 2 * TOLERANCE * norm(exact)
        followed += 1
    assert followed > 3


def test_a_warm_answer_is_as_good_as_the_cold_one(atlas, problem, border):
    first, second, pressure = border
    memory = atlas.new_warm()
    for share in np.linspace(0.2, 0.8, 7):
        x, force = first + share * (second - first), (0.5 + share / 2) * pressure
        warm, cold = atlas.press(x, force, warm=memory), atlas.press(x, force)
        u = problem.solve(Load(x, warm.direction, force)).displacement
        errors = [norm(atlas.displacement(answer) - u) / norm(u) for answer in (warm, cold)]
        assert errors[0] <= errors[1] + TOLERANCE


@pytest.fixture(scope="module")
def path(problem, border):
    """Return contact points 0.05 mm apart across a border and the full model's answers there."""
    first, second, pressure = border
    along = (second - first) / np.linalg.norm(second - first)
    points = (first + second) / 2 + 0.05 * np.arange(-8, 9)[:, None] * along
    answers, u = [], None
    for x in points:
        nodal, normal = problem.unit_load(x)
        u = problem.solve(Load(x, -normal, pressure), start=u).displacement
        answers.append(np.vstack([u, nodal @ u / nodal.sum()]))
    return points, answers


def jumps(atlas, path, pressure, warm=None):
    """Largest difference (mm) from the full model's increments, nodal or of the contact."""
    answers, active = [], set()
    for x in path[0]:
        solution = atlas.press(x, pressure, warm=warm)
        assert solution.converged
        active |= {k for k, _, _ in solution.parts}
        answers.append(np.vstack([atlas.displacement(solution), solution.contact_displacement]))
    assert len(active) > 1
    excess = np.diff(answers, axis=0) - np.diff(path[1], axis=0)
    return np.linalg.norm(excess, axis=2).max()


def test_across_a_border_it_jumps_no_more_than_the_full_model(atlas, path, border):
    assert jumps(atlas, path, border[2]) <= 0.01


def test_nor_does_it_when_warm(atlas, path, border):
    assert jumps(atlas, path, border[2], atlas.new_warm()) <= 0.01


def test_a_loose_tolerance_is_answered_in_fewer_iterations_and_well_within_it(atlas, galerkin):
    tolerance = Tolerance(displacement=0.05, von_mises=0.1)
    loose = atlas.scene.model_copy(update={"tolerance": tolerance})
    strict, other = (alone(atlas, galerkin, scene) for scene in (atlas.scene, loose))
    x = galerkin.centres[0]
    limit, iterations = atlas.press(x, 1.0).pressure_limit, np.zeros(2)
    for share in np.linspace(0.1, 1.0, 10):
        found = [pressed(own, x, share * limit) for own in (strict, other)]
        iterations += [count for count, _ in found]
        (_, q), (_, near) = found
        # in the norm of energy, which stresses follow: the solver's share is half at most
        assert norm(near - q) < 0.5 * tolerance.von_mises * norm(q)
    assert iterations[1] < iterations[0]
