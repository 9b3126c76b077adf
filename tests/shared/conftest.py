import pytest

from palpate.offline.fem.problem import FullProblem
from palpate.shared.artifact import read_artifact
from palpate.shared.model import ReducedModel


@pytest.fixture(scope="module")
def atlas(artifact):
    """Return the reduced model of the quick scene."""
    return ReducedModel.load(artifact)


@pytest.fixture(scope="module")
def problem(artifact):
    """Return the full model of the quick scene."""
    return FullProblem.of_artifact(read_artifact(artifact))
