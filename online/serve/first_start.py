"""The first start of a release, which compiles kernels: those of loads and of the tip at once.

A process compiles one kernel at a time, and answers nobody meanwhile.
"""

import os
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

from palpate.online.serve.service import ServedModel, Service, Stamp, artifacts_in

_PART = "import sys; from palpate.online.serve.first_start import _compile; _compile(*sys.argv[1:])"


def compile_kernels(artifacts: Path) -> None:
    """Compile what the smallest artifact of a folder needs, if nothing has been compiled yet.

    What others need beside it is compiled when they are loaded.
    """
    kernels, found = Path(os.environ["NUMBA_CACHE_DIR"]), dict[Path, Stamp]()
    with suppress(OSError):  # out of reach for a moment
        found = artifacts_in(artifacts)
    if any(kernels.glob("*/many.*.nbi")) or not found:
        return
    smallest = min(found, key=lambda path: found[path][1])
    read, held = os.pipe()  # ends with this process, and they with it
    try:
        parts = [
            subprocess.Popen(
                [sys.executable, "-c", _PART, part, str(smallest)],
                stdin=read,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            for part in ("loads", "tip")
        ]
        for process in parts:
            process.wait()
    finally:
        os.close(read)
        os.close(held)


def _compile(part: str, artifact: str) -> None:
    """Answer what compiles the kernels of a part; an artifact that is none is told elsewhere."""
    from palpate.online.serve.app import warm_loads, warm_tip
    from palpate.online.session.session import Sessions
    from palpate.online.settings import Settings
    from palpate.shared.model import ReducedModel

    threading.Thread(target=_end_with_parent, daemon=True).start()
    served = ServedModel.of(ReducedModel.load(artifact))
    if part == "loads":
        warm_loads(served)
    else:
        warm_tip(Sessions(Service(Settings())), served)


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)
