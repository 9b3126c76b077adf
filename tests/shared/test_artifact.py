import os
import time
from dataclasses import dataclass
from typing import Annotated, Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.shared import artifact as artifact_file
from palpate.shared.arrays import Array, Flags
from palpate.shared.artifact import (
    FORMAT_VERSION,
    SEAL_BYTES,
    ArtifactError,
    Dataset,
    read_artifact,
    write_artifact,
)


@dataclass
class Things:
    """What the file of these tests holds."""

    modes: Annotated[Array, "modes", "mm", "n, 30", "modes of the body"]
    basis: Annotated[NDArray[np.int16], "basis", "1", "9, 25 n", "steps", "", "compress"]
    clamped: Annotated[Flags, "clamped", "1", "2", "nodes held fixed"]
    extent: Annotated[float, "extent", "mm", "", "reach of a local model", "> 0"]


@dataclass
class Noise:
    """A compressed dataset of several chunks."""

    noise: Annotated[NDArray[Any], "noise", "1", "a, b, c", "noise", "", "compress"]


SCENE = 'name = "x"\n' * 20
DOCUMENTS = {"training": {"patches": 3}, "validation": {"displacement": {"mean": 0.01}}}
DATASETS = {
    "modes": Dataset(np.random.default_rng(1).random((40, 30)), "mm", "modes of the body"),
    "basis": Dataset(np.arange(9000, dtype=np.int16).reshape(9, -1), "1", "steps", compress=True),
    "clamped": Dataset(np.array([True, False]), "1", "nodes held fixed"),
    "extent": Dataset(np.array(2.5), "mm", "reach of a local model"),
}


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "x.h5"
    write_artifact(path, SCENE, DOCUMENTS, DATASETS)
    return path


def refusal(path):
    """Return why a file is refused, and insist that this takes no time."""
    started = time.perf_counter()
    with pytest.raises(ArtifactError) as refused:
        read_artifact(path, Things)
    assert time.perf_counter() - started < 2.0
    assert str(refused.value).startswith(f"{path}: ")
    return str(refused.value)


def test_what_is_written_is_read(path):
    artifact = read_artifact(path, Things)
    assert artifact.scene == SCENE
    assert artifact.documents == DOCUMENTS
    assert artifact.arrays.keys() == DATASETS.keys()
    for key, dataset in DATASETS.items():
        assert artifact.arrays[key].dtype == dataset.values.dtype
        np.testing.assert_array_equal(artifact.arrays[key], dataset.values)


@pytest.mark.parametrize("kind", [np.int8, np.int16, np.float32])
def test_what_is_compressed_in_many_chunks_is_what_hdf5_reads(tmp_path, rng, kind):
    path, values = tmp_path / "x.h5", np.zeros((9, 700, 251), kind)
    values[3:6] = rng.integers(-9, 9, (3, 700, 251))
    values[6:] = rng.normal(scale=40.0, size=(3, 700, 251))
    noise = Dataset(values, "1", "of three kinds", compress=True)
    write_artifact(path, SCENE, DOCUMENTS, {"noise": noise})
    with h5py.File(path) as file:
        stored = file["noise"]
        assert stored.id.get_num_chunks() > 2
        assert any(np.remainder(values.shape, stored.chunks))  # the last ones reach beyond
        np.testing.assert_array_equal(stored[()], values)
    read = read_artifact(path, Noise).arrays["noise"]
    assert read.dtype == kind
    np.testing.assert_array_equal(read, values)


def test_any_hdf5_tool_can_read_it_and_its_seal_is_a_line_of_text(path):
    with h5py.File(path) as file:
        assert file.attrs["format"] == "palpate-artifact"
        assert file.attrs["format_version"] == FORMAT_VERSION
        assert file.attrs["scene"] == SCENE
        for key, dataset in DATASETS.items():
            assert file[key].attrs["units"] == dataset.units
            assert file[key].attrs["description"] == dataset.description
            assert len(file[key].attrs["sha256"]) == 64
        assert file["basis"].compression == "gzip"
        assert file["basis"].id.get_storage_size() < DATASETS["basis"].values.nbytes / 2
        assert file["modes"].compression is None
    seal, version, checksum = path.read_bytes()[:SEAL_BYTES].split(b"\n")[0].split(b" ")
    assert (seal, version, len(checksum)) == (b"palpate-artifact", b"%d" % FORMAT_VERSION, 64)


def test_wherever_it_is_cut_off_it_is_refused(path):
    whole = path.read_bytes()
    cuts = {*range(0, len(whole), 97), 1, SEAL_BYTES - 1, SEAL_BYTES, len(whole) - 1}
    for length in cuts:
        path.write_bytes(whole[:length])
        assert refusal(path)
    path.write_bytes(whole + b"\0")
    assert "truncated or altered" in refusal(path)


def test_whichever_bit_is_flipped_it_is_refused(path, rng):
    whole = path.read_bytes()
    # all of the seal and of HDF5's root structures, samples of the rest
    places = {*range(1024), *rng.integers(0, len(whole), 1000).tolist()}
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        assert refusal(path)


def test_another_version_is_told(path):
    with path.open("r+b") as file:
        file.write(b"palpate-artifact 99 ")  # in as many digits
    assert f"format version 99, this software reads {FORMAT_VERSION}" in refusal(path)


@pytest.mark.parametrize("content", [0, 512, b"not HDF5 at all\n" * 100, b""])
def test_foreign_files_are_told(tmp_path, content):
    """HDF5 with user blocks of some bytes, text, nothing."""
    path = tmp_path / "foreign.h5"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        with h5py.File(path, "w", userblock_size=content) as file:
            file["temperature"] = [36.6, 37.1]
    assert "not an artifact" in refusal(path)


STRANGE = {
    "nan": ("modes", np.full((40, 30), np.nan), "values not finite"),
    "infinite": ("extent", np.array(np.inf), "values not > 0"),
    "negative": ("extent", np.array(-1.0), "values not > 0"),
    "shorter": ("basis", np.zeros((9, 999), np.int16), "is (9, 999) int16 and not (9, 25 n) int16"),
    "flat": ("modes", np.zeros(1200), "is (1200,) float64 and not (n, 30) float64"),
    "type": ("clamped", np.array([1, 0]), "is (2,) int64 and not (2) bool"),
    "text": ("clamped", np.array([b"a", b"b"]), "is (2,) |S1 and not (2) bool"),
}


@pytest.mark.parametrize(("name", "values", "reason"), STRANGE.values(), ids=STRANGE)
def test_what_its_fields_cannot_hold_is_refused_with_a_right_seal(tmp_path, name, values, reason):
    path = tmp_path / "x.h5"
    write_artifact(path, SCENE, DOCUMENTS, {**DATASETS, name: Dataset(values, "1", "strange")})
    assert reason in refusal(path)


def test_what_would_swell_in_memory_is_refused(path, monkeypatch):
    monkeypatch.setattr(artifact_file, "MOST_INFLATED", 1.5)  # the basis is compressed to less
    assert "dataset 'basis' has 18000 bytes, which is too much" in refusal(path)


def test_what_is_not_declared_is_not_read(tmp_path):
    path = tmp_path / "x.h5"
    more = Dataset(np.zeros((1000, 1000)), "1", "nobody asked for it", compress=True)
    write_artifact(path, SCENE, DOCUMENTS, {**DATASETS, "more": more})
    assert read_artifact(path, Things).arrays.keys() == DATASETS.keys()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="not known to this system")
def test_a_pipe_is_no_artifact(tmp_path):
    os.mkfifo(tmp_path / "pipe.h5")
    assert "not a regular file" in refusal(tmp_path / "pipe.h5")


def test_what_is_no_file_is_told(tmp_path):
    assert "No such file" in refusal(tmp_path / "absent.h5")
    assert "Is a directory" in refusal(tmp_path)


def test_a_write_that_fails_or_is_killed_leaves_what_was_there(path, monkeypatch):
    before = path.read_bytes()
    unwritable = Dataset(np.array([object()]), "1", "no numbers")
    with pytest.raises(TypeError):
        write_artifact(path, SCENE, DOCUMENTS, {**DATASETS, "bad": unwritable})
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_artifact(path, "other", {}, {})
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == ["x.h5"]


def test_the_umask_decides_who_reads_it(tmp_path):
    before = os.umask(0o027)
    try:
        write_artifact(tmp_path / "x.h5", SCENE, DOCUMENTS, DATASETS)
    finally:
        os.umask(before)
    assert (tmp_path / "x.h5").stat().st_mode & 0o777 == 0o640
