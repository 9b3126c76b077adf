import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize("first", ["shared.tissue", "offline.full_model", "numba"])
def test_kernels_are_cached_by_the_state_of_the_sources_whatever_is_imported_first(first):
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    script = f"import {first}; from shared import tissue; print(tissue.stress.stats.cache_path)"
    run = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert "kernels-" in run.stdout
