"""FElupe, an independent finite element code, agrees on our meshes, law and loads.

Nothing of ours reaches FElupe but the mesh (nodes, elements, clamped nodes), the material
parameters and the nodal load: shape functions, quadrature, assembly, Newton's method and linear
solver are its own, the law is written once more in its tensor algebra, and it walks to the load in
steps instead of one jump.
"""

import felupe as fem
import numpy as np
import pytest
from felupe.math import cdya_ik, cdya_il, det, dya, identity, inv, transpose
from scipy.sparse.linalg import splu

from palpate.offline.fem.mesh import build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.fem.surface import accessible_surface
from palpate.offline.scenes import find_scene
from palpate.shared.geometry.quadrature import surface_quadrature
from palpate.shared.mechanics.footprint import footprint

STEPS = 8

REGIONS = {
    "hex8": ("hexahedron", fem.RegionHexahedron),
    "hex8-mean-dilatation": ("hexahedron", fem.RegionHexahedron),
    "hex20": ("hexahedron20", fem.RegionQuadraticHexahedron),
}


def law(mu, lam):
    """FEAP's Neo-Hookean law: dW/dF and d2W/dF2 over trailing axes of points and cells."""

    def gradient(x):
        F, state = x[0], x[-1]
        J = det(F)
        return [mu * (F - iT(F)) + lam / 2 * (J**2 - 1) * iT(F), state]

    def hessian(x):
        F = x[0]
        J, eye = det(F), identity(F)
        return [
            mu * cdya_ik(eye, eye)
            + (mu - lam / 2 * (J**2 - 1)) * cdya_il(iT(F), iT(F))
            + lam * J**2 * dya(iT(F), iT(F))
        ]

    def iT(F):
        return transpose(inv(F))

    return fem.Material(gradient, hessian)


def solver(A, b):
    return splu(A.tocsc()).solve(b)


def displacement_by_felupe(model, load):
    """Displacement (nodes, 3) mm by FElupe."""
    cell_type, region_class = REGIONS[model.element]
    mesh = fem.Mesh(model.mesh.nodes, model.mesh.elements, cell_type)
    region = region_class(mesh, quadrature=fem.GaussLegendre(order=1, dim=3))
    umat = law(model.mu[0], model.lam[0])
    if model.element == "hex8-mean-dilatation":
        field = fem.FieldsMixed(region, n=3)
        umat = fem.ThreeFieldVariation(umat)
    else:
        field = fem.FieldContainer([fem.Field(region, dim=3)])
    solid = fem.SolidBody(umat, field)
    loaded = np.flatnonzero(load.any(axis=1))
    force = fem.PointLoad(field, loaded)
    clamped = fem.Boundary(field[0], mask=model.mesh.clamped)
    ramp = fem.math.linsteps([0, 1], num=STEPS)[1:, None, None] * load[loaded]
    step = fem.Step([solid, force], ramp={force: ramp}, boundaries={"clamped": clamped})
    fem.Job(steps=[step]).evaluate(x0=field, tol=1e-9, solver=solver, verbose=0)
    return field[0].values


def turbinate(element, divisions):
    """The turbinate of another element and other divisions."""
    scene = find_scene("turbinate")
    geometry = scene.geometry.model_copy(update={"element": element, "divisions": divisions})
    scene = scene.model_copy(update={"geometry": geometry})
    return FullModel.of(scene, build_mesh(scene))


def pressed(model, position, pressure, tilt):
    """Load (nodes, 3) mN of a footprint, tilted from the inward normal towards +y."""
    mesh = model.mesh
    x, normal, _ = accessible_surface(mesh).project(np.asarray(position))
    nodal = np.empty(len(mesh.nodes))
    footprint(surface_quadrature(mesh.nodes, mesh.faces), x, normal, 2.0, nodal)
    direction = -np.cos(tilt) * normal + np.sin(tilt) * np.array([0.0, 1.0, 0.0])
    return pressure * np.outer(nodal, direction)


@pytest.mark.parametrize(
    ("element", "divisions", "tolerance"),
    [
        ("hex8", (23, 3, 20), 1e-6),
        ("hex8-mean-dilatation", (16, 3, 12), 1e-5),
        ("hex20", (13, 2, 13), 1e-6),
    ],
)
def test_displacement_under_a_large_load(element, divisions, tolerance):
    model = turbinate(element, divisions)
    load = pressed(model, (10.2, 20.0, 9.0), 8.0, tilt=np.radians(20))
    ours = model.solve(load)
    theirs = displacement_by_felupe(model, load)
    error = np.linalg.norm(ours.displacement - theirs) / np.linalg.norm(theirs)
    print(f"{element}: relative L2 difference {error:.1e}")
    assert np.abs(ours.displacement).max() > 2.0
    assert error <= tolerance
