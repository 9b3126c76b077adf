"""What both sides need: scenes, tissue, loads, equilibrium, reduced models, artifacts."""

import hashlib
import os
import sys
from pathlib import Path

KERNELS = ("shared", "offline", "offline/methods", "online")
"""Folders of sources with kernels, or with constants that are compiled into them."""


def _kernel_cache() -> None:
    """Give compiled kernels a cache of their own for every state of the sources.

    Numba renews a cached kernel when the file that defines it changes, but not when a kernel of
    another file that was compiled into it does: after an update it would go on running old physics.
    """
    packages = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for source in sorted(
        source for folder in KERNELS for source in (packages / folder).glob("*.py")
    ):
        digest.update(source.read_bytes())
    cache = Path(__file__).parent / "__pycache__"
    if os.access(cache if cache.exists() else cache.parent, os.W_OK):
        folder = cache / f"kernels-{digest.hexdigest()[:16]}"
        os.environ.setdefault("NUMBA_CACHE_DIR", str(folder))
        if "numba" in sys.modules:  # it has read its environment already
            sys.modules["numba"].config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]


def _one_thread_of_blas() -> None:
    """Keep BLAS to one thread, if NumPy has not come in yet.

    The products of a query are too small to share, and a BLAS thread that waits for a busy core
    turns 0.3 ms into 100; shared or not, they differ in the last bit. Long work runs in processes.
    """
    for library in ("OPENBLAS", "MKL", "OMP"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")


_one_thread_of_blas()
_kernel_cache()
