"""What both sides need: scenes, tissue, loads, equilibrium, reduced models, artifacts."""

import atexit
import hashlib
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

PACKAGES = Path(__file__).parents[1]

_IMPORT = re.compile(r"^ *from palpate\.([\w.]+) import (\([^)]*\)|.*)", re.MULTILINE)


def kernel_sources() -> list[Path]:
    """Sources with kernels, and those they import from: constants of theirs are compiled too."""
    texts = {
        source: source.read_text()
        for package in ("shared", "offline", "online")
        for source in (PACKAGES / package).rglob("*.py")
    }
    pending = [source for source, text in texts.items() if "from numba" in text]
    found = set(pending)
    while pending:
        for module, names in _IMPORT.findall(texts[pending.pop()]):
            place = PACKAGES.joinpath(*module.split("."))
            candidates = [place, *(place / name for name in re.findall(r"\w+", names))]
            for candidate in candidates:
                source = candidate.with_suffix(".py")
                if source in texts and source not in found:
                    found.add(source)
                    pending.append(source)
    return sorted(found)


def _kernel_cache() -> None:
    """Give compiled kernels a cache of their own for every state of their sources.

    Numba renews a cached kernel when the file that defines it changes, but not when a kernel of
    another file that was compiled into it does: after an update it would go on running old physics.
    """
    if "NUMBA_CACHE_DIR" not in os.environ:
        digest = hashlib.sha256()
        for source in kernel_sources():
            digest.update(source.read_bytes())
        folder = _writable(Path(__file__).parent / "__pycache__", digest.hexdigest()[:16])
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:  # it has read its environment already
        sys.modules["numba"].config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]


def _writable(cache: Path, key: str) -> Path:
    """Folder of kernels in a cache, or where that cannot be written in the user's.

    The latter begins with links to what the former has, as does one for once where there is none.
    """
    own = cache / f"kernels-{key}"
    if os.access(cache if cache.exists() else cache.parent, os.W_OK):
        return own
    try:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = caches / "palpate" / own.name
        folder.parent.mkdir(parents=True, exist_ok=True)
        if not folder.exists():
            _begin_cache(folder, own)
    except (OSError, RuntimeError):  # the latter of users without a home
        folder = Path(tempfile.mkdtemp(prefix="palpate-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        _begin_cache(folder, own)
        said = (
            "no folder for compiled kernels can be written; set NUMBA_CACHE_DIR to one, or new ones"
        )
        print(f"palpate: {said} are compiled each time", file=sys.stderr)
    return folder


def _begin_cache(folder: Path, own: Path) -> None:
    """Make a folder of kernels with links to those that the installation has."""
    folder.mkdir(exist_ok=True)
    if own.is_dir():
        shutil.copytree(own, folder, copy_function=os.symlink, dirs_exist_ok=True)


def _one_thread_of_blas() -> None:
    """Keep BLAS to one thread, if NumPy is not imported yet.

    The products of a query are too small to share, and a BLAS thread that waits for a busy core
    turns 0.3 ms into 100; shared or not, they differ in the last bit. Long work runs in processes.
    """
    for library in ("OPENBLAS", "MKL", "OMP"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")


_one_thread_of_blas()
_kernel_cache()
