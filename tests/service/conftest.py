import os
import re
import signal
import subprocess
from contextlib import contextmanager

import pytest

from ..conftest import PALPATE


class Server:
    """A running `palpate serve`.

    `url` is its address, `greeting` what it printed when it was ready, `log` its stderr once it
    has ended.
    """

    def __init__(self, directory, *arguments, **environment):
        self.process = subprocess.Popen(
            [*PALPATE, "serve", "--artifacts", directory, "--port", "0", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1", **environment},
        )
        self.greeting = ""
        while "Try:" not in self.greeting:
            line = self.process.stdout.readline()
            assert line, self.process.communicate()
            self.greeting += line
        self.url = re.search(r"http://[\d.]+:\d+", self.greeting)[0]
        self.log = ""

    def stop(self, number=signal.SIGTERM):
        """Send a signal and return the exit code."""
        self.process.send_signal(number)
        _, self.log = self.process.communicate(timeout=10)
        return self.process.returncode


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
