import pytest

from palpate.offline.fem.problem import FullProblem


@pytest.fixture(scope="module")
def problem(artifact):
    """Return the full model of the quick scene."""
    return FullProblem.of_artifact(artifact)
