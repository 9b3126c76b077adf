import numpy as np

from palpate.offline.reduce.join import neighbours, overlaps


def test_neighbours_are_all_pairs_within_reach(atlas):
    models = atlas.models
    reach = 1.5 * models.extent
    away = np.linalg.norm(models.centres[:, None] - models.centres, axis=2)
    expected = np.argwhere(np.triu(away <= reach, 1))
    np.testing.assert_array_equal(neighbours(models, reach), expected)


def test_overlaps_are_products_of_modes_in_the_energy_of_the_rest_state(atlas, problem):
    model, models, modes = problem.model, atlas.models, atlas.models.modes
    pairs = neighbours(models, 1.5 * models.extent)
    pairs = pairs[:: max(1, len(pairs) // 6)]
    found = overlaps(model, models, modes, pairs)
    for (k, n), overlap in zip(pairs, found, strict=True):
        V, W = (
            np.transpose(
                [atlas.fields._field({models.region[p]: q}).ravel()[model.free] for q in modes[p].T]
            )
            for p in (k, n)
        )
        np.testing.assert_allclose(overlap, V.T @ (model.rest_stiffness @ W), atol=2e-3)
    own = overlaps(model, models, modes, np.array([[0, 0]], np.int32))[0]
    np.testing.assert_allclose(own, np.eye(len(own)), atol=5e-3)
