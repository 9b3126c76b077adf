"""FElupe, an independent finite element code, agrees on our meshes, law and loads.

Nothing of ours reaches FElupe but the mesh (nodes, elements, clamped nodes), the material
parameters and the nodal load: shape functions, quadrature, assembly, Newton's method and linear
solver are its own, every law is written once more in its tensor algebra, and it walks to the load
in steps instead of one jump.
"""

import itertools
import time
from functools import partial
from statistics import median

import felupe as fem
import numpy as np
import pytest
from felupe.math import cdya_ik, cdya_il, det, dot, dya, identity, inv, trace, transpose
from scipy.sparse.linalg import splu, spsolve

from palpate.offline.fem.mesh import accessible_surface, build_mesh
from palpate.offline.fem.model import FullModel
from palpate.offline.scenes import find_scene
from palpate.shared.geometry.quadrature import surface_quadrature
from palpate.shared.mechanics.footprint import footprint
from palpate.shared.scene import parse_scene

from ..offline.fem.bodies import in_tetrahedra

STEPS = 5

REGIONS = {
    8: ("hexahedron", fem.RegionHexahedron),
    20: ("hexahedron20", fem.RegionQuadraticHexahedron),
    10: ("tetra10", fem.RegionQuadraticTetra),
}


def neo_hookean(mu, lam):
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


def mooney_rivlin(C, J, eye, inverse, mu, c01):
    """Isochoric second Piola-Kirchhoff stress."""
    first = trace(C)
    second = (first**2 - trace(dot(C, C))) / 2
    S = (mu - 2 * c01) * J ** (-2 / 3) * (eye - first / 3 * inverse)
    return S + 2 * c01 * J ** (-4 / 3) * (first * eye - C - 2 / 3 * second * inverse)


def demiray(C, J, eye, inverse, mu, b):
    """The same."""
    growth = np.exp(b * (J ** (-2 / 3) * trace(C) - 3))
    return mu * growth * J ** (-2 / 3) * (eye - trace(C) / 3 * inverse)


def separated(isochoric, mu, lam, *constants):
    """Laws of separate isochoric and volumetric stress, whose derivative is by differences."""

    def stress(F):
        C, J = dot(transpose(F), F), det(F)
        eye, inverse = identity(C), inv(C)
        volumetric = (lam + 2 / 3 * mu) / 2 * (J**2 - 1) * inverse
        return dot(F, isochoric(C, J, eye, inverse, mu, *constants) + volumetric)

    def hessian(x):
        A = np.empty((3, 3, *x[0].shape))
        for k, n in itertools.product(range(3), repeat=2):
            step = np.zeros_like(x[0])
            step[k, n] = 1e-6
            A[:, :, k, n] = (stress(x[0] + step) - stress(x[0] - step)) / 2e-6
        return [A]

    return fem.Material(lambda x: [stress(x[0]), x[-1]], hessian)


LAWS = {
    "neo-hookean": neo_hookean,
    "mooney-rivlin": partial(separated, mooney_rivlin),
    "demiray": partial(separated, demiray),
}


def solver(A, b):
    return splu(A.tocsc()).solve(b)


def felupe_body(model, quadrature=None, law=None):
    """The same body and its field in FElupe."""
    cell_type, region_class = REGIONS[model.mesh.elements.shape[1]]
    mesh = fem.Mesh(model.mesh.nodes, model.mesh.elements, cell_type)
    region = region_class(mesh, quadrature=quadrature or fem.GaussLegendre(order=1, dim=3))
    constants = law or model.law
    umat = LAWS[model.tissue.law](*(value[None] for value in constants))  # by point and element
    field = fem.FieldContainer([fem.Field(region, dim=3)])
    return fem.SolidBody(umat, field), field


def felupe_bodies(model):
    """As ``felupe_body``; of tetrahedra two, which share what resists a change of volume."""
    if model.mesh.elements.shape[1] != 10:
        solid, field = felupe_body(model)
        return [solid], field
    mu, lam = model.law
    share = np.minimum(lam, mu)
    solid, field = felupe_body(model, fem.TetrahedronQuadrature(order=2), (mu, share))
    other, _ = felupe_body(model, fem.TetrahedronQuadrature(order=1), (0.0 * mu, lam - share))
    return [solid, other], field


def displacement_by_felupe(model, load):
    """Displacement (nodes, 3) mm by FElupe."""
    solids, field = felupe_bodies(model)
    loaded = np.flatnonzero(load.any(axis=1))
    force = fem.PointLoad(field, loaded)
    clamped = fem.Boundary(field[0], mask=model.mesh.clamped)
    ramp = fem.math.linsteps([0, 1], num=STEPS)[1:, None, None] * load[loaded]
    step = fem.Step([*solids, force], ramp={force: ramp}, boundaries={"clamped": clamped})
    fem.Job(steps=[step]).evaluate(x0=field, tol=1e-9, solver=solver, verbose=0)
    return field[0].values


def body(name, element, divisions, region=None):
    """The body of a scene, of another element and other divisions, maybe with a region."""
    scene = find_scene(name)
    if region:
        scene = parse_scene(scene.text + region, scene.folder)
    hexahedra = "hex8" if element == "tet10" else element
    geometry = scene.geometry.model_copy(update={"element": hexahedra, "divisions": divisions})
    scene = scene.model_copy(update={"geometry": geometry})
    mesh = build_mesh(scene)
    return FullModel(in_tetrahedra(mesh) if element == "tet10" else mesh, scene.tissue)


def pressed(model, position, pressure, tilt):
    """Load (nodes, 3) mN of a footprint, tilted from the inward normal towards +y."""
    mesh = model.mesh
    x, normal, _ = accessible_surface(mesh).project(np.asarray(position))
    nodal = np.empty(len(mesh.nodes))
    footprint(surface_quadrature(mesh.nodes, mesh.faces), x, normal, 2.0, nodal)
    direction = -np.cos(tilt) * normal + np.sin(tilt) * np.array([0.0, 1.0, 0.0])
    return pressure * np.outer(nodal, direction)


@pytest.mark.parametrize(
    ("name", "element", "divisions", "position", "pressure", "least", "tolerance"),
    [
        ("turbinate-paper", "hex8", (23, 3, 20), (10.2, 20.0, 9.0), 8.0, 2.0, 1e-6),
        ("turbinate-paper", "hex20", (13, 2, 13), (10.2, 20.0, 9.0), 8.0, 2.0, 1e-6),
        ("turbinate-paper", "tet10", (13, 2, 13), (10.2, 20.0, 9.0), 8.0, 2.0, 1e-8),
        ("quick-mooney-rivlin", "hex20", (4, 4, 3), (5.0, 5.0, 8.0), 9.0, 0.9, 1e-8),
        ("quick-demiray", "hex20", (4, 4, 3), (5.0, 5.0, 8.0), 9.0, 0.9, 1e-8),
    ],
)
def test_displacement_under_a_large_load(
    name, element, divisions, position, pressure, least, tolerance
):
    model = body(name, element, divisions)
    load = pressed(model, position, pressure, tilt=np.radians(20))
    ours = model.solve(load).displacement
    theirs = displacement_by_felupe(model, load)
    error = np.linalg.norm(ours - theirs) / np.linalg.norm(theirs)
    print(f"{name}, {element}: relative L2 difference {error:.1e}")
    assert np.abs(ours).max() > least
    assert error <= tolerance


STIFF = """
[[tissue.region]]
name = "core"
young = {young}
poisson = 0.3
x = [2.0, 8.0]
y = [2.0, 8.0]
z = [2.5, 6.0]
"""


@pytest.mark.parametrize("element", ["hex20", "tet10"])
def test_displacement_with_a_region_a_thousand_times_as_stiff(element):
    young = 1000.0 * find_scene("quick").tissue.young
    model = body("quick", element, (4, 4, 3), STIFF.format(young=young))
    assert 0 < model.mesh.region.sum() < len(model.mesh.elements) / 2
    load = pressed(model, (5.0, 5.0, 8.0), 6.0, tilt=np.radians(20))
    ours = model.solve(load).displacement
    theirs = displacement_by_felupe(model, load)
    error = np.linalg.norm(ours - theirs) / np.linalg.norm(theirs)
    print(f"a stiff region, {element}: relative L2 difference {error:.1e}")
    assert np.abs(ours).max() > 0.3
    assert error <= 1e-8


def our_step(model, load):
    """Correction of a Newton step from a displacement (nodes, 3) mm."""
    force, full_load = np.empty(load.size), load.ravel()

    def step(state):
        model.internal(state.ravel(), force)
        model.solver.factorise(model.stiffness(state.ravel()).data)
        return model.solver.solve((full_load - force)[model.free])

    return step


def felupe_step(model, load, solve):
    """The same by FElupe's own assembly, with nothing of its bookkeeping round it."""
    solid, field = felupe_body(model)
    free, full_load = model.free, load.ravel()

    def step(state):
        field[0].values[:] = state
        force = solid.assemble.vector(field).toarray()[:, 0]
        matrix = solid.assemble.matrix()
        return solve(matrix[free, :][:, free], (full_load - force)[free])

    return step


def by_minimum_degree(A, b):
    """Solve with SciPy's better ordering for symmetric matrices."""
    return splu(A.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(b)


@pytest.mark.parametrize(("element", "divisions"), [("hex8", (23, 3, 20)), ("hex20", (13, 2, 13))])
def test_a_newton_step_is_the_same_and_timed(element, divisions):
    """Both codes on one thread, in turns, each step at another state than the last."""
    model = body("turbinate-paper", element, divisions)
    load = pressed(model, (10.2, 20.0, 9.0), 4.0, tilt=0.0)
    halfway = model.solve(load / 2).displacement  # as in the middle of a solve
    theirs = [felupe_step(model, load, solve) for solve in (spsolve, by_minimum_degree)]
    steps, times = (our_step(model, load), *theirs), ([], [], [])
    for number in range(3):  # 20 tell the ratio well; the first does not count
        corrections = []
        for step, own in zip(steps, times, strict=True):
            started = time.perf_counter()
            corrections.append(step((1 - 1e-4 * number) * halfway))
            own.append(time.perf_counter() - started)
        for correction in corrections[1:]:
            scale = np.abs(corrections[0]).max()
            np.testing.assert_allclose(correction, corrections[0], atol=1e-8 * scale)
    ours, default, ordered = (median(own[1:]) for own in times)
    print(f"{element}: {default / ours:.1f} x ours, with a better ordering {ordered / ours:.1f} x")
