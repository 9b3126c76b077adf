"""The full model of visco-elastic tissue under the rigid tip, in time."""

import numpy as np
import pytest

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.terms import TipContact, TipLoad
from palpate.offline.scenes import find_scene
from palpate.shared.mechanics.neo_hookean import NeoHookeanTissue
from palpate.shared.mechanics.sphere import tip_of, tip_surface

PRONY = ((0.25, 0.1), (0.25, 1.0))
YOUNG, POISSON, RADIUS = 15.0, 0.45, 2.0
TOP = np.array([4.0, 4.0, 6.0])


@pytest.fixture(scope="module")
def block():
    """A block clamped at its bottom, and its contact with a tip."""
    scene = find_scene("quick")
    geometry = scene.geometry.model_copy(update={"size": (8.0, 8.0, 6.0), "divisions": (3, 3, 2)})
    mesh = build_mesh(scene.model_copy(update={"geometry": geometry}))
    tissue = NeoHookeanTissue(law="neo-hookean", young=YOUNG, poisson=POISSON, prony=PRONY)
    model = FullModel(mesh, "hex20", tissue)
    surface = tip_surface(mesh.nodes, mesh.faces, mesh.accessible, RADIUS)
    return model, TipContact(model, surface, tip_of(RADIUS, YOUNG))


def place(depth, aside=0.0):
    """Centre of the tip, and the way it has come."""
    return TOP + np.array([aside, 0.0, RADIUS - depth]), np.array([0.0, 0.0, -max(depth, 0.0)])


def follow(block, course, past=None):
    """Answers along a course of depths (mm), places aside (mm) and time steps (s)."""
    model, contact = block
    answers = []
    for depth, aside, dt in course:
        answers.append(model.solve(TipLoad(contact, *place(depth, aside)), past, dt))
        past = answers[-1].past
    return answers


def test_at_once_tissue_answers_as_without_time(block):
    model, contact = block
    sudden = model.solve(TipLoad(contact, *place(0.5, 0.2)), model.at_rest)
    elastic = model.solve(TipLoad(contact, *place(0.5, 0.2)))
    np.testing.assert_allclose(sudden.displacement, elastic.displacement, atol=1e-9)
    np.testing.assert_allclose(sudden.force, elastic.force, rtol=1e-9)
    np.testing.assert_allclose(sudden.tangent, elastic.tangent, rtol=1e-6, atol=1e-6)


def test_after_long_the_force_is_that_of_relaxed_tissue(block):
    model, contact = block
    answers = follow(block, [(0.5, 0.2, 0.0), *[(0.5, 0.2, 5.0)] * 4])
    relaxed = model.relaxed.solve(TipLoad(contact, *place(0.5, 0.2)))
    forces = [np.linalg.norm(answer.force) for answer in answers]
    assert np.all(np.diff(forces) < 1e-9)
    np.testing.assert_allclose(answers[-1].force, relaxed.force, rtol=1e-4, atol=1e-4)
    assert 0.5 < forces[-1] / forces[0] < 0.7  # half of what is isochoric relaxes


def test_a_held_tip_relaxes_as_the_law_says(block):
    """For a small dent: what relaxes is ``sum g (1 - exp(-t / tau))`` of the isochoric part."""
    held = [(0.02, 0.0, 0.0), *[(0.02, 0.0, 0.05)] * 20, (0.02, 0.0, 1e9)]
    forces = np.array([answer.force[2] for answer in follow(block, held)])
    times = np.array([0.0, *(0.05 * np.arange(1, 21))])
    lost = sum(g * (1 - np.exp(-times / tau)) for g, tau in PRONY) / sum(g for g, _ in PRONY)
    shown = (forces[0] - forces[:-1]) / (forces[0] - forces[-1])
    # not exact: the ratio of moduli changes, and with it a little of the shape
    np.testing.assert_allclose(shown, lost, atol=0.04)


def test_a_closed_path_dissipates(block, rng):
    """Work on the tool over random closed paths: never more comes out than was put in."""
    for _ in range(6):
        depths = np.concatenate([[0.0], rng.uniform(0.1, 0.7, 3), [0.0]])
        asides = np.concatenate([[0.0], rng.uniform(-0.6, 0.6, 3), [0.0]])
        ticks = np.linspace(0, 4, 25)
        course = np.column_stack(
            [np.interp(ticks, np.arange(5), depths), np.interp(ticks, np.arange(5), asides)]
        )
        dt = 10 ** rng.uniform(-2.5, 0.0)
        answers = follow(block, [(*row, dt) for row in course])
        force = np.array([answer.force for answer in answers])
        moves = np.diff(course, axis=0) @ [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
        work = -np.sum((force[1:] + force[:-1]) / 2 * moves, axis=1)
        assert work.sum() > 0.0
        assert work.sum() < work[work > 0].sum()


def test_the_tangent_is_the_derivative_of_the_force_of_a_step(block):
    model, contact = block
    past = follow(block, [(0.5, 0.0, 0.05), (0.5, 0.3, 0.1), (0.3, 0.3, 0.02)])[-1].past
    dt, h = 0.02, 1e-4
    position, approach = place(0.4, 0.3)
    found = model.solve(TipLoad(contact, position, approach), past, dt)
    for axis, step in enumerate(h * np.eye(3)):
        ahead, behind = (
            model.solve(TipLoad(contact, position + s * step, approach), past, dt).force
            for s in (1, -1)
        )
        error = np.abs(found.tangent[:, axis] - (ahead - behind) / (2 * h)).max()
        assert error <= 1e-3 * np.abs(found.tangent).max()


def test_a_lifted_tip_leaves_a_dent_that_recovers(block):
    lifted = follow(block, [(0.6, 0.0, 0.0), (0.6, 0.0, 2.0), (-0.1, 0.0, 0.0)])[-1]
    assert not lifted.force.any()
    dent = np.abs(lifted.displacement).max()
    assert 0.01 < dent < 0.6
    later = follow(block, [(-0.1, 0.0, 4.0)] * 6, lifted.past)[-1]
    assert np.abs(later.displacement).max() < 0.01 * dent
