"""The full model under the rigid tip: a footprint of some force with Hertz's law in series."""

import numpy as np
import pytest

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.fem.problem import FullProblem, Load, TipPosition
from palpate.offline.scenes import find_scene
from palpate.offline.studies.layer import ball_on_a_layer
from palpate.offline.validate.mesh_part import TIP_GRADING, compared
from palpate.shared.scene import parse_scene

SLAB = """
name = "slab"
geometry.kind = "block"
geometry.size = [32.0, 32.0, 12.0]
geometry.divisions = [11, 11, 4]
tissue.law = "neo-hookean"
tissue.young = 4.0
tissue.poisson = 0.45
support.side = "bottom"
surface.side = "top"
endoscope.radius = 3.0
endoscope.max_tilt = 30.0
endoscope.tip = true
load.max_indentation = 0.3
"""


def over(problem, depth, aside=(0.0, 0.0)):
    """A tip in the middle of the top, or aside, so deep."""
    top = problem.mesh.nodes.max(axis=0)
    centre = top * [0.5, 0.5, 1.0] + [*aside, problem.scene.endoscope.radius - depth]
    return TipPosition(centre)


def test_a_ball_on_a_layer_is_that_of_hertz_whatever_the_mesh():
    """Faces of 2.9 mm under a tip of 3 mm: the contact's radius is 0.4 to 1.1 mm."""
    problem, depths = FullProblem(parse_scene(SLAB)), np.array([0.05, 0.1, 0.2, 0.4])
    forces = [problem.solve(over(problem, depth)).force[2] for depth in depths]
    theory = [ball_on_a_layer(depth, 3.0, 12.0, young=4.0, poisson=0.45) for depth in depths]
    np.testing.assert_allclose(forces, theory, rtol=0.012)
    slope = np.polyfit(np.log(depths), np.log(np.divide(forces, theory)), 1)[0]
    assert abs(slope) < 0.01


@pytest.mark.parametrize("poisson", [0.3, 0.45])
def test_at_an_edge_the_force_is_that_of_a_sphere_integrated_on_a_fine_mesh(poisson):
    """As it leans: without the law's change with the place the force is 10 % off and more."""
    scene = parse_scene(SLAB.replace("tissue.poisson = 0.45", f"tissue.poisson = {poisson}"))
    problem, radius = FullProblem(scene), scene.endoscope.radius
    for aside in (0.0, 0.1):
        levels = [
            (depth, TipPosition(np.array([16.0, aside * radius, 12.0 + radius - depth])), None)
            for depth in (0.15, 0.6)
        ]
        for *_, found, exact in compared(problem, scene, levels, TIP_GRADING):
            off = np.linalg.norm(found.felt - exact.felt) / np.linalg.norm(exact.felt)
            assert off < 0.08


@pytest.mark.parametrize(
    ("name", "place", "off"),
    [
        ("quick", (4.0, 7.0, 8.0), 0.002),
        ("turbinate-paper", (10.18, 20.0, 11.0), 0.01),
        # triangles, on which places lie, cut the round edge by a micrometre
        ("turbinate-paper", (6.3, 20.0, 0.1), 0.06),
    ],
)
def test_the_tangent_is_the_derivative_of_the_force(name, place, off):
    problem = FullProblem(find_scene(name))
    radius, h = problem.scene.endoscope.radius, 1e-3
    x, normal, _ = problem.surface.project(np.array(place))
    centre = x + (radius - 0.4) * normal
    found = problem.solve(TipPosition(centre))
    size = np.abs(found.tangent).max()
    np.testing.assert_allclose(found.tangent, found.tangent.T, atol=2e-3 * size)
    for axis, step in enumerate(h * np.eye(3)):
        ahead, behind = (problem.solve(TipPosition(centre + s * step)).force for s in (1, -1))
        error = np.abs(found.tangent[:, axis] - (ahead - behind) / (2 * h)).max()
        assert error <= off * size


def test_at_the_rim_the_tip_stays_on_the_surface(problem):
    top = problem.mesh.nodes.max(axis=0)
    found = problem.solve(over(problem, 0.3, aside=(0.5 * top[0] + 0.6, 0.0)))
    assert found.force[0] > 0.1 * found.force[2] > 0.0


def test_a_tip_off_the_block_moves_nothing(problem):
    found = problem.solve(over(problem, -0.01))
    assert not found.displacement.any()
    assert not found.force.any()


def test_a_tip_that_no_tissue_bears_is_refused(problem):
    with pytest.raises(NoEquilibrium):
        problem.solve(over(problem, 30.0))


def test_a_held_tip_relaxes_and_a_lifted_one_leaves_a_dent_that_recovers(visco_problem):
    problem, past, forces = visco_problem, None, []
    for dt in (0.0, 0.05, 0.3, 2.0, 5.0, 5.0, 50.0):
        found = problem.solve(TipPosition(over(problem, 0.4).position, dt), past)
        past = found.past
        forces.append(found.force[2])
    assert np.all(np.diff(forces) < 1e-6 * forces[0])
    share = sum(g for g, _ in problem.model.prony)
    # what is isochoric relaxes by that share, and E* by a little less
    assert 1 - share < forces[-1] / forces[0] < 1 - 0.85 * share
    lifted = problem.solve(TipPosition(over(problem, -0.2).position, 0.0), past)
    dent = np.abs(lifted.displacement).max()
    assert not lifted.force.any()
    assert dent > 0.02
    later = problem.solve(TipPosition(over(problem, -0.2).position, 20.0), lifted.past)
    assert np.abs(later.displacement).max() < 0.05 * dent


def test_the_turbinate_answers_from_a_millionth_of_its_range_on():
    problem = FullProblem(find_scene("turbinate-paper"))
    x, normal, _ = problem.surface.project(np.array([10.18, 20.0, 11.0]))
    moved = [
        problem.solve(Load(x, -normal, share * 3.67)).displacement / share
        for share in (1e-6, 1e-5, 1e-4)
    ]
    for other in moved[:2]:
        assert np.linalg.norm(other - moved[2]) <= 1e-3 * np.linalg.norm(moved[2])
    forces = [
        np.linalg.norm(problem.solve(TipPosition(x + (2.0 - 1.42 * share) * normal)).force)
        for share in (1e-6, 1e-5, 1e-4, 1e-3)
    ]
    assert np.all(np.diff(forces) > 0.0)
