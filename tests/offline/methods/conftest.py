import numpy as np
import pytest

from palpate.offline.methods.catalogue import Training
from palpate.offline.methods.method import Snapshots
from palpate.offline.validate.queries import held_out_loads, random_loads

SNAPSHOTS, QUERIES = 40, 4


@pytest.fixture(scope="session")
def training(atlas, problem):
    rng = np.random.default_rng(0)
    loads = random_loads(atlas, SNAPSHOTS, rng)
    solved = [problem.solve(load).displacement.ravel() for load in loads]
    return Training(problem, Snapshots(loads, np.stack(solved)), atlas)


@pytest.fixture(scope="session")
def basis(training):
    """Return the first modes of the snapshots (free dofs, 12)."""
    return training.pod(12)


@pytest.fixture(scope="session")
def queries(atlas, problem):
    """Return loads that no method has seen, and their full solutions (n, 3)."""
    loads = held_out_loads(atlas, QUERIES, 1)
    return [(load, problem.solve(load).displacement) for load in loads]
