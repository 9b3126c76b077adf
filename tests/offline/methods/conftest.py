import numpy as np
import pytest

from palpate.offline.methods.catalogue import Training
from palpate.offline.methods.method import Snapshots
from palpate.offline.run.workshop import Workshop
from palpate.offline.validate.loads import random_loads, unseen_loads
from palpate.shared.artifact import read_artifact
from palpate.shared.model import ReducedModel

SNAPSHOTS, QUERIES = 40, 4


@pytest.fixture(scope="session")
def atlas(artifact):
    return ReducedModel.load(artifact)


@pytest.fixture(scope="session")
def workshop(artifact):
    return Workshop.of_artifact(read_artifact(artifact))


@pytest.fixture(scope="session")
def training(atlas, workshop):
    rng = np.random.default_rng(0)
    loads = random_loads(atlas.surface, atlas.limits, atlas.scene, SNAPSHOTS, rng)
    solved = [workshop.solve(load).displacement.ravel() for load in loads]
    return Training(workshop, Snapshots(loads, np.stack(solved)), atlas)


@pytest.fixture(scope="session")
def queries(atlas, workshop):
    """Return loads that no method has seen, and their full solutions (n, 3)."""
    loads = unseen_loads(atlas, QUERIES, 1)
    return [(load, workshop.solve(load).displacement) for load in loads]
