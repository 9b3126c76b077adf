"""Artifacts that were changed and sealed anew: refused by name, or answered soundly."""

import time

import h5py
import numpy as np
import pytest

from palpate.shared.artifact import ArtifactError, read_artifact
from palpate.shared.errors import QueryError
from palpate.shared.model import STORED, ReducedModel

from ..conftest import sealed

CHANGES = {
    "nan": lambda a, _: np.full_like(a, np.nan),
    "one nan": lambda a, rng: _put(a, rng, np.nan),
    "infinite": lambda a, rng: _put(a, rng, np.inf),
    "largest": lambda a, rng: _put(a, rng, np.iinfo(a.dtype).max),
    "negative": lambda a, rng: _put(a, rng, -1),
    "shorter": lambda a, _: a[:-1],
    "longer": lambda a, _: np.concatenate([a, a[-1:]]),
    "flat": lambda a, _: a.ravel(),
    "empty": lambda a, _: a[:0],
    "wider": lambda a, _: a.astype(np.longdouble if a.dtype.kind == "f" else np.int64),
    "text": lambda a, _: np.full(a.shape, b"?"),
    "absent": lambda *_: None,
}
LEFT = {
    "largest": {"basis", "patch_modes"},
    "negative": {"basis", "patch_modes"},
    "nan": {"patch_cubature_errors"},
    "one nan": {"patch_cubature_errors"},
    "shorter": {"surface_triangles"},
    "longer": {"elements", "surface_triangles"},
    "wider": {"basis"},
}
"""What an artifact could hold as well."""

OF_FLOATS, OF_INTEGERS = {"nan", "one nan", "infinite"}, {"largest", "negative"}


def _put(values, rng, value):
    changed = values.copy()
    changed.reshape(-1)[rng.integers(changed.size)] = value
    return changed


@pytest.fixture(scope="module")
def whole(artifact):
    return read_artifact(artifact, *STORED)


def fitting(values, change):
    if not values.size:  # modes that quick has none of
        return False
    kind = values.dtype.kind
    if change in OF_FLOATS:
        return kind == "f"
    if change in OF_INTEGERS:
        return kind == "i"
    return change == "absent" or values.ndim > 0


@pytest.mark.parametrize("change", CHANGES)
def test_every_dataset_that_is_changed_is_refused_by_name_or_answered_soundly(
    whole, artifact, tmp_path, change, rng
):
    path, taken = tmp_path / "resealed.h5", set[str]()
    names = [name for name, values in whole.arrays.items() if fitting(values, change)]
    for name in names:
        values = CHANGES[change](whole.arrays[name], rng)
        if values is not None and same(values, whole.arrays[name]):
            continue
        arrays = whole.arrays | {name: values}
        if values is None:
            del arrays[name]
        sealed(path, whole, arrays=arrays)
        started = time.perf_counter()
        model, reason = loaded(path)
        assert reason.startswith(f"{path}: ") if model is None else sound(model), name
        if model is not None:
            taken.add(name)
        assert time.perf_counter() - started < 5.0, name
    assert taken == LEFT.get(change, set())


def same(one, other):
    return (one.dtype, one.shape) == (other.dtype, other.shape) and (
        one.tobytes() == other.tobytes()
    )


def loaded(path):
    """The model, or why there is none."""
    try:
        return ReducedModel.load(path), ""
    except ArtifactError as error:
        return None, str(error)


def sound(model):
    """Whether answers are finite or say that they are none."""
    for x in model.surface.vertices[:: max(1, len(model.surface.vertices) // 5)]:
        try:
            answers = model.press(x, 0.5), model.touch(x + np.array([0.0, 0.0, 1.5]))
        except QueryError:
            continue
        for answer in answers:
            known = np.concatenate([answer.force, answer.contact_displacement])
            if answer.converged and not np.isfinite(known).all():
                return False
    return True


def test_a_dataset_that_claims_to_be_huge_takes_no_memory(whole, tmp_path, monkeypatch):
    path = tmp_path / "huge.h5"
    create = h5py.Group.create_dataset

    def claim(group, name, *more, data=None, **options):
        if name == "body_modes":
            return create(group, name, (2_000_000, data.shape[1]), data.dtype, chunks=True)
        return create(group, name, *more, data=data, **options)

    monkeypatch.setattr(h5py.Group, "create_dataset", claim)
    sealed(path, whole)
    with pytest.raises(ArtifactError, match="body_modes"):
        ReducedModel.load(path)


@pytest.mark.parametrize(("name", "value"), [("faces", 0), ("patch_centres", 1e3)])
def test_what_does_not_fit_together_is_refused_when_it_is_loaded(whole, tmp_path, name, value):
    """A face without an area, and a local model that is far from all faces."""
    values = whole.arrays[name].copy()
    values[0] = value
    path = sealed(tmp_path / "apart.h5", whole, arrays=whole.arrays | {name: values})
    with pytest.raises(ArtifactError, match="incomplete or inconsistent"):
        ReducedModel.load(path)


def test_a_surface_whose_triangles_have_no_area_is_refused(whole, tmp_path):
    path, vertices = tmp_path / "resealed.h5", whole.arrays["surface_vertices"].copy()
    vertices[whole.arrays["surface_triangles"][0]] = vertices[0]
    sealed(path, whole, arrays=whole.arrays | {"surface_vertices": vertices})
    model, reason = loaded(path)
    assert model is None
    assert "triangles of it have no area" in reason
