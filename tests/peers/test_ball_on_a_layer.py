"""The rigid tip on a bonded layer beside an axisymmetric solution made of FElupe's elements."""

import felupe as fe
import numpy as np
from scipy.sparse.linalg import splu

from palpate.offline.fem.problem import FullProblem, TipPosition
from palpate.shared.scene import parse_scene

YOUNG, POISSON, RADIUS, HEIGHT = 4.0, 0.45, 3.0, 12.0

SLAB = f"""
name = "slab"
geometry.kind = "block"
geometry.size = [32.0, 32.0, {HEIGHT}]
geometry.divisions = [11, 11, 4]
tissue.law = "neo-hookean"
tissue.young = {YOUNG}
tissue.poisson = {POISSON}
support.side = "bottom"
surface.side = "top"
endoscope.radius = {RADIUS}
endoscope.max_tilt = 30.0
endoscope.tip = true
load.max_indentation = 0.3
"""


def axisymmetric(depths, along=240, through=120, wide=60.0):
    """Forces (mN) of a frictionless rigid ball on a layer, linear elasticity, by an active set."""
    mesh = fe.Rectangle(n=(through + 1, along + 1))
    height, radius = mesh.points.T
    mesh.points[:] = np.column_stack([HEIGHT * (1 - (1 - height) ** 2.2), wide * radius**3])
    region = fe.RegionQuad(mesh)
    field = fe.FieldContainer([fe.FieldAxisymmetric(region, dim=2)])
    body = fe.SolidBody(fe.LinearElastic(E=YOUNG, nu=POISSON), field)
    K = body.assemble.matrix().tocsc()
    z, r = mesh.points.T
    held = (z < 1e-9) | (r > wide - 1e-9)
    free = np.flatnonzero(np.column_stack([~held, ~(held | (r < 1e-9))]).ravel())
    top = np.flatnonzero((z > HEIGHT - 1e-9) & (r < 0.9 * RADIUS))
    rows = np.searchsorted(free, 2 * top)
    units = np.zeros((len(free), len(top)))
    units[rows, np.arange(len(top))] = 1.0
    compliance = splu(K[free][:, free]).solve(units)[rows]
    forces = []
    for depth in depths:
        ball = RADIUS - np.sqrt(RADIUS**2 - r[top] ** 2) - depth  # what the surface must stay below
        touching = ball < 0.0
        for _ in range(100):
            force = np.zeros(len(top))
            force[touching] = np.linalg.solve(
                compliance[np.ix_(touching, touching)], ball[touching]
            )
            now = (touching & (force <= 0.0)) | (~touching & (compliance @ force > ball + 1e-12))
            if (now == touching).all():
                break
            touching = now
        forces.append(-force.sum())
    return np.array(forces)


def test_its_force_is_that_of_an_axisymmetric_solution_whatever_the_mesh():
    depths = np.array([0.1, 0.2, 0.4])
    problem = FullProblem(parse_scene(SLAB))  # faces of 2.9 mm
    middle = problem.mesh.nodes.max(axis=0) * [0.5, 0.5, 1.0]
    centres = [np.add(middle, (0.0, 0.0, RADIUS - depth)) for depth in depths]
    forces = np.array([problem.solve(TipPosition(centre)).force[2] for centre in centres])
    exact, coarser = axisymmetric(depths), axisymmetric(depths, 160, 80)
    np.testing.assert_allclose(coarser, exact, rtol=3e-3)
    np.testing.assert_allclose(forces, exact, rtol=0.015)
    slope = np.polyfit(np.log(depths), np.log(forces), 1)[0]
    assert abs(slope - np.polyfit(np.log(depths), np.log(exact), 1)[0]) < 0.01
