import pytest

from palpate.offline.fem.problem import FullProblem
from palpate.shared.artifact import read_artifact


@pytest.fixture(scope="module")
def problem(artifact):
    """Return the full model of the quick scene."""
    return FullProblem.of_artifact(read_artifact(artifact))
