import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from shared import KERNELS

PACKAGES = Path(__file__).parents[2]


@pytest.mark.parametrize("first", ["shared.tissue", "offline.full_model", "numba"])
def test_kernels_are_cached_by_the_state_of_the_sources_whatever_is_imported_first(first):
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    script = f"import {first}; from shared import tissue; print(tissue.stress.stats.cache_path)"
    run = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert "kernels-" in run.stdout


@pytest.mark.parametrize("package", ["shared", "offline", "online"])
def test_sources_with_kernels_are_part_of_that_state(package):
    for source in (PACKAGES / package).rglob("*.py"):
        names = {node.id for node in ast.walk(ast.parse(source.read_text())) if hasattr(node, "id")}
        if "njit" in names:
            assert source.parent.relative_to(PACKAGES).as_posix() in KERNELS, source
