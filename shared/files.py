"""Files that people name: regular ones are read, whole ones written, and names can be shown."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path


def open_regular(path: Path) -> BufferedReader:
    """Open a file for reading; a pipe or a device, which may never end, raises ``OSError``."""
    number = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    file = os.fdopen(number, "rb")
    if not stat.S_ISREG(os.fstat(number).st_mode):
        file.close()
        raise OSError(f"{path} is not a regular file")
    return file


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Name a file in each ``OSError``: that of a full disk has no name."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def write_whole(path: Path, *parts: bytes | memoryview) -> None:
    """Write a file beside its place, flush it to disk, then move it there.

    Where that fails nothing of it stays, and the ``OSError`` has its name.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        with named(path), part.open("wb") as file:
            file.writelines(parts)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def printable(text: str) -> str:
    """Escape what of a text, such as a file's name, cannot be shown on one line anywhere."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )
