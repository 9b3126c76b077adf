import os
import re
import subprocess
import sys

import pytest

from palpate.shared import PACKAGES, kernel_sources


@pytest.mark.parametrize(
    "first", ["palpate.shared.mechanics.laws", "palpate.offline.fem.model", "numba"]
)
def test_kernels_are_cached_by_the_state_of_the_sources_whatever_is_imported_first(first):
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    script = f"""
import {first}
from palpate.shared.mechanics import laws
print(laws.tangent.stats.cache_path)
"""
    run = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert "kernels-" in run.stdout


def test_sources_with_kernels_and_what_they_import_make_that_state_and_no_others():
    names = {source.relative_to(PACKAGES).as_posix() for source in kernel_sources()}
    for source in PACKAGES.glob("*/**/*.py"):
        if re.search(r"^@njit", source.read_text(), re.MULTILINE):
            assert source.relative_to(PACKAGES).as_posix() in names
    assert "shared/errors.py" in names  # imported by modules with kernels
    assert not names & {"online/serve/app.py", "offline/commands.py"}
