"""The artifact: one HDF5 file per scene, written whole or not at all, verified when read.

A file holds plain numeric datasets, each with ``units``, a one-line ``description`` and the SHA-256
of its bytes, and as root attributes the format's name and version, the scene's text, and JSON
documents (provenance, training and validation figures).  Nothing in it is executed or unpickled.

Before the HDF5 part stands a seal, one line of text in HDF5's user block: the format's name and
version and the SHA-256 of the rest of the file.  It is checked before HDF5 sees the file: one wrong
bit in HDF5's own structures can keep its library busy for ever.
"""

import hashlib
import json
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import h5py
import numpy as np
from numpy.typing import NDArray

from palpate.shared.arrays import number_type
from palpate.shared.errors import PalpateError
from palpate.shared.files import open_regular, write_whole

FORMAT = "palpate-artifact"
FORMAT_VERSION = 11

MOST_INFLATED = 100
"""Bytes of a dataset over those that it takes in the file."""

SEAL_BYTES = 512
"""The smallest user block that HDF5 offers."""


class ArtifactError(PalpateError):
    """A file that is no usable artifact; the message names the file and what is wrong with it."""


@dataclass(frozen=True)
class Dataset:
    """An array with what a reader needs to know of it; integers gain from being compressed."""

    values: NDArray[Any]
    units: str
    description: str
    compress: bool = False


@dataclass(frozen=True)
class Artifact:
    """Contents of an artifact."""

    scene: str  # the TOML text
    documents: dict[str, Any]  # JSON-able: ``provenance``, ``training``, ``validation``
    arrays: dict[str, NDArray[Any]]
    seal: str = ""  # SHA-256 of the file it was read from


class Stored(NamedTuple):
    """How a dataclass's field is stored, which is what it is ``Annotated`` with.

    ``shape`` has numbers and names of sizes, products of them, or so many more: ``"p + 1, 3 n"``.
    ``values`` says which ones a reader can do with, beside finite ones: ``"< n"``, numbers from 0
    on of that many things; ``"rising to n"``, from 0; ``"> 0"``; ``"nan"``, which may be among
    them.
    """

    name: str  # of the dataset; a field that may be None has one only if it is not
    units: str
    shape: str
    description: str
    values: str = ""
    how: str = ""  # "compress", worth while for integers, or "half": in half precision
    type: Any = None  # of its numbers in memory, if it must be one

    @property
    def dtype(self) -> Any:
        """Type of its numbers in a file."""
        return np.float16 if self.how == "half" else self.type

    def check(self, found: NDArray[Any] | h5py.Dataset, sizes: dict[str, int]) -> None:
        """Raise ``ValueError`` unless type and shape are right; learns sizes not known so far."""
        right = self.dtype is None or found.dtype == self.dtype
        axes = self.shape.split(", ") if self.shape else []
        if not right or len(axes) != found.ndim or not all(map(_fits(sizes), axes, found.shape)):
            at = ", ".join(f"{name} = {size}" for name, size in sizes.items())
            is_, wanted = f"{found.shape} {found.dtype}", f"({self.shape}) {np.dtype(self.dtype)}"
            raise ValueError(f"dataset {self.name!r} is {is_} and not {wanted}, {at}")

    def check_values(self, values: NDArray[Any], sizes: dict[str, int]) -> None:
        """Raise ``ValueError`` unless all values are such as a reader can do with."""
        usable = values.dtype.kind in "iub" or bool(np.isfinite(values).all())
        match self.values.partition(" "):
            case "<", _, size:
                top = _extent(size, sizes)
                usable = not values.size or 0 <= values.min() <= values.max() < top
            case "rising", _, end:
                last = sizes[end.removeprefix("to ")]
                usable = values[0] == 0 <= np.diff(values).min() and values[-1] == last
            case ">", _, _:
                usable = usable and bool((values > 0).all())
            case "nan", _, _:
                usable = not np.isinf(values).any()
        if not usable:
            raise ValueError(f"dataset {self.name!r} has values not {self.values or 'finite'}")


def _extent(product: str, sizes: Mapping[str, int]) -> int:
    """Value of a product of numbers and names of sizes."""
    return math.prod(int(part) if part.isdigit() else sizes[part] for part in product.split())


def _fits(sizes: dict[str, int]) -> Callable[[str, int], bool]:
    """Whether an axis is as long as a shape says; learns the one size that is not known."""

    def fits(axis: str, length: int) -> bool:
        product, _, more = axis.partition(" + ")
        parts, length = product.split(), length - int(more or 0)
        for name in (part for part in parts if not part.isdigit() and part not in sizes):
            parts.remove(name)
            sizes[name] = length // (_extent(" ".join(parts), sizes) or 1)
            break
        return length == _extent(product, sizes)

    return fits


def _stored_fields(kind: type) -> dict[str, Stored]:
    """Stored fields of a dataclass, by their names."""
    found = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if note := getattr(hint, "__metadata__", ()):
            found[name] = Stored(*note)._replace(type=_number_type(get_args(hint)[0]))
    return found


def _number_type(kind: Any) -> Any:
    """Type of the numbers of an annotated array or number; None if it may be any."""
    dtype = number_type(kind) if get_args(kind) else np.float64
    return None if dtype is Any else dtype


def datasets_of(record: Any) -> dict[str, Dataset]:
    """Datasets of the stored fields of a dataclass, and of those that are its fields, by name."""
    datasets: dict[str, Dataset] = {}
    for name, stored in _stored_fields(type(record)).items():
        value = getattr(record, name)
        if value is not None:
            values = np.asarray(value, np.float16 if stored.how == "half" else None)
            what = f"{stored.description} ({stored.shape})"
            datasets[stored.name] = Dataset(values, stored.units, what, stored.how == "compress")
    for item in fields(record):
        value = getattr(record, item.name)
        if is_dataclass(value):
            datasets |= datasets_of(value)
    return datasets


def values_of(kind: type, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Values of the stored fields of a dataclass, by the fields' names; numbers are floats."""
    defaults = {item.name: item.default for item in fields(kind)}
    values: dict[str, Any] = {}
    for name, stored in _stored_fields(kind).items():
        if stored.name in arrays or defaults[name] is not None:
            array = arrays[stored.name]
            values[name] = array.astype(np.float32) if stored.how == "half" else array
            if not array.ndim:
                values[name] = array.item()
    return values


def digest(values: NDArray[Any]) -> str:
    """SHA-256 of an array's type, shape and bytes."""
    values = np.ascontiguousarray(values)
    header = f"{values.dtype.str}{values.shape}".encode()
    sha = hashlib.sha256(header)
    sha.update(values.data)
    return sha.hexdigest()


def write_artifact(
    path: Path, scene: str, documents: Mapping[str, Any], datasets: Mapping[str, Dataset]
) -> None:
    """Write an artifact, whole or not at all.

    HDF5 has it in memory: where the disk is full, HDF5 itself would crash.
    """
    image = BytesIO()
    with h5py.File(image, "w", userblock_size=SEAL_BYTES) as file:
        file.attrs["format"] = FORMAT
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["scene"] = scene
        file.attrs["documents"] = json.dumps(documents, sort_keys=True)
        for key, dataset in datasets.items():
            worthwhile = dataset.compress and dataset.values.size > 0
            filters = {"compression": 4, "shuffle": True} if worthwhile else {}
            stored = file.create_dataset(key, data=dataset.values, **filters)
            stored.attrs["units"] = dataset.units
            stored.attrs["description"] = dataset.description
            stored.attrs["sha256"] = digest(dataset.values)
    rest = image.getbuffer()[SEAL_BYTES:]
    seal = f"{FORMAT} {FORMAT_VERSION} {hashlib.sha256(rest).hexdigest()}\n".encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, seal.ljust(SEAL_BYTES, b"\0"), rest)


def read_artifact(path: Path, *kinds: type) -> Artifact:
    """Read and verify an artifact, with the stored fields of dataclasses as far as it has them.

    Raises
    ------
    ArtifactError
        If the file is missing, truncated, altered, of another format or of another version, or has
        what these fields cannot hold.
    """
    try:
        with open_regular(path) as file:
            seal = _check_seal(file, path)
        with h5py.File(path, "r") as opened:
            return replace(_read(opened, path, kinds), seal=seal)
    except ArtifactError:
        raise
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # h5py raises whatever a file leads it to
        raise ArtifactError(f"{path}: incomplete: {error}") from error


def _check_seal(file: BufferedReader, path: Path) -> str:
    seal = re.fullmatch(rb"%b (\d+) ([0-9a-f]{64})\n\0+" % FORMAT.encode(), file.read(SEAL_BYTES))
    if seal is None:
        raise ArtifactError(f"{path}: not an artifact of this software")
    version = int(seal[1])
    if version != FORMAT_VERSION:
        raise ArtifactError(
            f"{path}: format version {version}, this software reads {FORMAT_VERSION}; "
            "train the scene again or use the matching release"
        )
    if _digest_of_rest(file) != seal[2].decode():
        raise ArtifactError(f"{path}: truncated or altered: it does not match its checksum")
    return seal[2].decode()


def _digest_of_rest(file: BufferedReader) -> str:
    """SHA-256 of all that follows the seal."""
    file.seek(SEAL_BYTES)
    return hashlib.file_digest(file, "sha256").hexdigest()


def _read(file: h5py.File, path: Path, kinds: Sequence[type]) -> Artifact:
    arrays, sizes = {}, dict[str, int]()
    declared = [stored for kind in kinds for stored in _stored_fields(kind).values()]
    present = [stored for stored in declared if stored.name in file]
    for stored in present:
        found = file[stored.name]
        stored.check(found, sizes)
        if found.nbytes > MOST_INFLATED * found.id.get_storage_size():
            raise ValueError(f"dataset {stored.name!r} has {found.nbytes} bytes, which is too much")
        arrays[stored.name] = _values(found)
        if digest(arrays[stored.name]) != found.attrs["sha256"]:
            raise ArtifactError(
                f"{path}: altered: dataset {stored.name!r} does not match its checksum"
            )
    for stored in present:
        stored.check_values(arrays[stored.name], sizes)
    return Artifact(str(file.attrs["scene"]), json.loads(str(file.attrs["documents"])), arrays)


def _values(found: h5py.Dataset) -> NDArray[Any]:
    """Values of a dataset; if compressed, decompressed by all cores, where HDF5 uses one."""
    if found.compression != "gzip" or not found.shuffle:
        return found[()]
    values = np.empty(found.shape, found.dtype)
    with ThreadPoolExecutor() as threads:
        for _ in threads.map(partial(_fill, values, found), found.iter_chunks()):
            pass  # but raise what it raised
    return values


def _fill(values: NDArray[Any], found: h5py.Dataset, at: tuple[slice, ...]) -> None:
    """Read a chunk: first bytes of its values, then second ones and so on, all compressed."""
    _, compressed = found.id.read_direct_chunk([own.start for own in at])
    width = found.dtype.itemsize
    content = zlib.decompressobj().decompress(compressed, width * math.prod(found.chunks))
    planes = np.frombuffer(content, np.uint8).reshape(width, -1)
    chunk = np.stack([*planes], axis=-1).view(found.dtype).reshape(found.chunks)
    values[at] = chunk[tuple(slice(own.stop - own.start) for own in at)]
