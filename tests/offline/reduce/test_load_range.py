"""The pressure that moves the tissue as far as wanted, and where to look for it."""

import numpy as np
import pytest

from palpate.offline.fem.model import NoEquilibrium
from palpate.offline.reduce.load_range import LoadPath, load_range, pressure_that_moves


def spring(law, limit=np.inf):
    """One node that moves by ``law(pressure)`` and has no equilibrium beyond ``limit``."""
    asked = []

    def solve(pressure, start):
        asked.append(pressure)
        if pressure > limit:
            raise NoEquilibrium("load: too much")
        return np.array([[0.0, 0.0, law(pressure)]])

    return solve, asked


@pytest.mark.parametrize("guess", [0.01, 1.0, 40.0])
@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_it_finds_the_pressure_of_a_power_law(power, guess):
    solve, asked = spring(lambda p: 2.0 * p**power)
    pressure, exponent, _ = pressure_that_moves(solve, 3.0, guess)
    assert pressure == pytest.approx(1.5 ** (1 / power), rel=1e-6)
    assert exponent == pytest.approx(power, rel=1e-6)
    assert len(asked) <= 12
    solve, asked = spring(lambda p: 2.0 * p**power)
    again, *_ = pressure_that_moves(solve, 3.0, 0.97 * pressure, exponent=power)
    assert again == pytest.approx(pressure)
    assert len(asked) == 1  # a known exponent saves the second solution


def test_beyond_the_last_equilibrium_it_stops_within_three_percent_or_says_that_there_is_none():
    solve, _ = spring(lambda p: p, limit=0.7)
    assert 0.7 / 1.03 <= pressure_that_moves(solve, 3.0, 2.0)[0] <= 0.7
    solve, asked = spring(lambda p: p, limit=0.0)
    with pytest.raises(NoEquilibrium):
        pressure_that_moves(solve, 3.0, 2.0)
    assert len(asked) < 15


def test_the_path_is_near_the_full_model(problem):
    x = problem.surface.vertices[len(problem.surface.vertices) // 2]
    nodal, normal = problem.unit_load(x)
    force = -nodal[:, None] * normal
    path = LoadPath(problem.model, force.reshape(-1)[problem.model.free])
    limit = load_range(problem, x)[0]
    for share, allowed in ((0.1, 1e-3), (0.5, 0.02), (1.0, 0.1)):
        exact = problem.model.solve(share * limit * force).displacement
        error = np.linalg.norm(path.solve(share * limit, None) - exact)
        assert error <= allowed * np.linalg.norm(exact)


@pytest.mark.parametrize("name", ["problem", "visco_problem"])
def test_the_limit_moves_the_tissue_by_the_indentation_in_the_end(request, name):
    problem = request.getfixturevalue(name)
    x = problem.surface.vertices[len(problem.surface.vertices) // 2]
    nodal, normal = problem.unit_load(x)
    limit = load_range(problem, x)[0]
    u = problem.model.relaxed.solve(-limit * nodal[:, None] * normal).displacement
    wanted = problem.scene.load.max_indentation * problem.scene.geometry.size[2]
    assert np.linalg.norm(u, axis=1).max() == pytest.approx(wanted, rel=0.01)
