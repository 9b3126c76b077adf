import numpy as np
import pytest

from palpate.offline.fem.problem import FullProblem
from palpate.offline.reduce.join import neighbours, overlaps
from palpate.shared.artifact import read_artifact
from palpate.shared.model import ReducedModel


@pytest.fixture(scope="module")
def trained(artifact):
    return ReducedModel.load(artifact), FullProblem.of_artifact(read_artifact(artifact)).model


def test_neighbours_are_all_pairs_within_reach(trained):
    models = trained[0].models
    reach = 1.5 * models.extent
    away = np.linalg.norm(models.centres[:, None] - models.centres, axis=2)
    expected = np.argwhere(np.triu(away <= reach, 1))
    np.testing.assert_array_equal(neighbours(models, reach), expected)


def test_overlaps_are_products_of_modes_in_the_energy_of_the_rest_state(trained):
    atlas, model = trained
    models, tips = atlas.models, atlas.models.tips
    pairs = tips.pairs[:: max(1, len(tips.pairs) // 6)]
    found = overlaps(model, models, tips.modes, pairs)
    for (k, n), overlap in zip(pairs, found, strict=True):
        V, W = (
            (models.basis[r] * models.steps[r][:, None])[:, model.free].T @ tips.modes[patch]
            for patch, r in ((k, models.region[k]), (n, models.region[n]))
        )
        np.testing.assert_allclose(overlap, V.T @ (model.rest_stiffness @ W), atol=2e-3)
    own = overlaps(model, models, tips.modes, np.array([[0, 0]], np.int32))[0]
    np.testing.assert_allclose(own, np.eye(len(own)), atol=5e-3)
