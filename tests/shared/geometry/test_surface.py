"""Projection onto a triangulated surface."""

import itertools

import numpy as np
import pytest

from palpate.shared.geometry.surface import Surface


@pytest.fixture(scope="module")
def surface(cells=6):
    """Return a square of 6 mm with a hump, its normals those of the hump."""
    x, y = np.meshgrid(*2 * [np.linspace(-3, 3, cells + 1)], indexing="ij")
    z = np.exp(-(x**2 + y**2) / 4)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    slopes = np.stack([x / 2 * z, y / 2 * z, np.ones_like(z)], axis=-1).reshape(-1, 3)
    corner = np.arange((cells + 1) * cells).reshape(cells, -1)[:, :-1].ravel()
    a, b, c, d = corner, corner + cells + 1, corner + cells + 2, corner + 1
    triangles = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    normals = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    return Surface(vertices, triangles.astype(np.int32), normals)


def closest_by_search(surface, p):
    """Nearest distance over interior, edges and corners of every triangle, each in closed form."""
    best = np.inf
    for triangle in surface.triangles:
        corners = surface.vertices[triangle]
        a, edges = corners[0], (corners[1:] - corners[0]).T
        weights = np.linalg.lstsq(edges, p - a, rcond=None)[0]
        if (weights >= 0).all() and weights.sum() <= 1:
            best = min(best, np.linalg.norm(p - a - edges @ weights))
        for start, end in itertools.combinations(corners, 2):
            along = end - start
            t = np.clip((p - start) @ along / (along @ along), 0, 1)
            best = min(best, np.linalg.norm(p - start - t * along))
    return best


def test_projection_is_the_nearest_point(surface, rng):
    corners = surface.vertices[surface.triangles[rng.integers(len(surface.triangles), size=30)]]
    on_it = np.einsum("pc,pci->pi", rng.dirichlet(np.ones(3), 30), corners)
    for p in (*on_it, *rng.uniform([-5, -5, -2], [5, 5, 4], (60, 3))):
        x, _, distance = surface.project(p)
        assert distance == pytest.approx(closest_by_search(surface, p), abs=1e-12)
        assert np.linalg.norm(p - x) == pytest.approx(distance, abs=1e-12)


def test_the_normal_is_the_vertex_normal_at_vertices_and_a_unit_vector_between(surface, rng):
    for vertex, normal in zip(surface.vertices, surface.normals, strict=True):
        assert surface.project(vertex)[1] == pytest.approx(normal, abs=1e-12)
    for p in rng.uniform(-3, 3, (20, 3)):
        assert np.linalg.norm(surface.project(p)[1]) == pytest.approx(1.0, abs=1e-14)


def test_the_normal_is_continuous_along_a_path(surface):
    path = np.column_stack([np.linspace(-2.9, 2.9, 400), np.full(400, 0.3), np.full(400, 2.0)])
    hits = [surface.project(p)[:2] for p in path]
    points, normals = (np.array(values) for values in zip(*hits, strict=True))
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    turn = np.linalg.norm(np.diff(normals, axis=0), axis=1)
    # Across an edge both move on; the normal never jumps while the point stands still.
    assert (turn <= 1.5 * step + 1e-12).all()


def test_a_far_position_lands_on_the_rim(surface):
    x, _, distance = surface.project(np.array([1000.0, 0.0, 0.0]))
    assert x[0] == pytest.approx(3.0)
    assert distance == pytest.approx(997.0, rel=1e-4)


def test_curvature_is_that_of_a_ball_and_of_a_cylinder():
    """Convex is positive; along the cylinder's axis there is none."""
    for axis in (np.zeros(3), np.array([0.0, 1.0, 0.0])):
        x, y = np.meshgrid(*2 * [np.linspace(-1.5, 1.5, 13)], indexing="ij")
        z = np.sqrt(25.0 - x**2 - (0.0 if axis.any() else y**2))
        vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
        normals = vertices - np.outer(vertices @ axis, axis)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        ball = Surface(vertices, np.zeros((0, 3), np.int32), normals)
        flat = np.einsum("ni,nj->nij", normals, normals) + np.outer(axis, axis)
        expected = (np.eye(3) - flat) / 5.0
        found = ball.curvature(1.0, np.empty((0, 6)))[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(
            -1, 3, 3
        )
        assert np.abs(found - expected).max() < 2e-3
