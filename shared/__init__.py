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


_kernel_cache()
