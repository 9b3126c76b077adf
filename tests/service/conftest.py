import ctypes
import gc
import os
import re
import signal
import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

from palpate.shared.artifact import read_artifact
from palpate.shared.model import STORED

from ..conftest import PALPATE, sealed


def rewritten(artifact, path, old, new):
    """Write an artifact anew, with other words in its scene; return where."""
    whole = read_artifact(artifact, *STORED)
    assert old in whole.scene
    return sealed(path, whole, scene=whole.scene.replace(old, new))


def process_memory(pid):
    """Bytes that a process holds; this one first gives back what it would give back later."""
    if pid == os.getpid():
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


class Server:
    """A running `palpate serve`.

    `url` is its address, `greeting` what it printed when it was ready, `log` its stderr once it
    has ended.
    """

    def __init__(self, directory, *arguments, **environment):
        # no pipe, which would fill and stop it
        self._stderr = tempfile.TemporaryFile("w+")  # noqa: SIM115
        self.process = subprocess.Popen(
            [*PALPATE, "serve", "--artifacts", directory, "--port", "0", *arguments],
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1", **environment},
        )
        self.greeting = ""
        while "Try:" not in self.greeting:
            line = self.process.stdout.readline()
            if not line:
                raise AssertionError(self._said())
            self.greeting += line
        self.url = re.search(r"http://[\d.]+:\d+", self.greeting)[0]
        self.log = ""

    def stop(self, number=signal.SIGTERM):
        """Send a signal and return the exit code."""
        self.process.send_signal(number)
        self.process.communicate(timeout=10)
        self.log = self._said()
        self._stderr.close()
        return self.process.returncode

    def _said(self):
        self._stderr.seek(0)
        return self._stderr.read()


@pytest.fixture(scope="session")
def serve():
    """Return a context manager that serves a directory of artifacts from a process of its own.

    Further arguments are options of `palpate serve`, keywords are environment variables.
    """

    @contextmanager
    def serving(directory, *arguments, **environment):
        server = Server(directory, *arguments, **environment)
        try:
            yield server
        finally:
            if server.process.poll() is None:
                server.stop()

    return serving


@pytest.fixture(scope="session")
def server(serve, artifact):
    """Return a server of the quick scene."""
    with serve(artifact.parent) as server:
        yield server
