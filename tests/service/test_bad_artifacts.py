"""Artifacts that cannot be trusted are refused and named; the others are served."""

import shutil

import h5py
import pytest

from palpate.online.client.http import Client

pytestmark = pytest.mark.service


def truncate(path):
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size // 2)


def flip_a_bit(path):
    """Flip one bit in the middle of the largest dataset's bytes."""
    datasets = []
    with h5py.File(path) as file:
        file.visititems(
            lambda _, item: datasets.append(item) if isinstance(item, h5py.Dataset) else None
        )
        largest = max(datasets, key=lambda dataset: dataset.id.get_storage_size())
        if largest.chunks is None:
            offset, size = largest.id.get_offset(), largest.id.get_storage_size()
        else:
            chunk = largest.id.get_chunk_info(0)
            offset, size = chunk.byte_offset, chunk.size
    with path.open("r+b") as file:
        file.seek(offset + size // 2)
        octet = file.read(1)[0]
        file.seek(-1, 1)
        file.write(bytes([octet ^ 4]))


def claim_a_newer_format(path):
    with path.open("r+b") as file:
        file.write(b"palpate-artifact 9 ")


def be_foreign(path):
    with h5py.File(path, "w") as file:
        file["temperature"] = [36.6, 37.1]


def be_text(path):
    path.write_text("not HDF5 at all\n")


def be_empty(path):
    path.write_bytes(b"")


DAMAGES = (truncate, flip_a_bit, claim_a_newer_format, be_foreign, be_text, be_empty)


@pytest.fixture(scope="module")
def damaged(artifact, serve, tmp_path_factory):
    """Return a server of one good artifact among damaged copies of it."""
    directory = tmp_path_factory.mktemp("damaged")
    shutil.copy(artifact, directory / "good.h5")
    for damage in DAMAGES:
        path = directory / f"{damage.__name__}.h5"
        shutil.copy(artifact, path)
        damage(path)
    (directory / "a_directory.h5").mkdir()
    with serve(directory) as server:
        yield server


@pytest.mark.parametrize("name", [*(damage.__name__ for damage in DAMAGES), "a_directory"])
def test_a_damaged_artifact_is_refused_and_named(damaged, name):
    with Client(damaged.url) as client:
        reasons = {entry["file"]: entry["reason"] for entry in client.scenes()["refused"]}
    reason = reasons[f"{name}.h5"]
    assert f"{name}.h5" in reason
    assert "another file" not in reason
    assert reason in damaged.greeting


def test_the_good_one_is_served(damaged):
    with Client(damaged.url) as client:
        assert [scene["name"] for scene in client.scenes()["scenes"]] == ["quick"]
        example = client.scene("quick")["example"]["contacts"][0]
        assert client.solve("quick", **example).trust["converged"]


def test_the_log_names_every_refused_file(serve, artifact, tmp_path):
    shutil.copy(artifact, tmp_path / "good.h5")
    be_text(tmp_path / "text.h5")
    with serve(tmp_path) as server:
        assert server.stop() == 0
    assert "text.h5" in server.log
    assert "Traceback" not in server.log
