"""What clients that attack take from a session at 1 kHz: a study, whose figures are of one machine.

    python -m tests.service.attacks artifacts/turbinate.h5 --seconds 20

For each attack a service is started anew, and a session is timed alone and beside the attack, as is
``/health``; the service's memory is read meanwhile. Where there are two cores the service has one
of them and all clients the other, the session first: what is told is then the service's doing.
"""

import os
import socket
import tempfile
import threading
import time
from collections import Counter, deque
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import click
import numpy as np

from palpate.online.client.http import Client
from palpate.online.client.session import Session

from .conftest import Server, process_memory

MANY = 900  # connections at once
PIECE = 65536  # bytes that are sent at once
HEAD = b"GET /health HTTP/1.1\r\nhost: localhost\r\n"
MESH = b"GET /scenes/%b/mesh?region=all HTTP/1.1\r\nhost: localhost\r\n\r\n"
CORES = sorted(os.sched_getaffinity(0))


def connected(url):
    parts = urlsplit(url)
    return socket.create_connection((parts.hostname, parts.port), timeout=5.0)


def endless(url, first, more):
    """Send a request that does not end, again and again."""
    piece = more * (PIECE // len(more))
    while True:
        with suppress(OSError), connected(url) as connection:
            connection.sendall(first)
            while True:
                connection.sendall(piece)


def many(url, first, more):
    """Keep many connections that read nothing and send a little each second."""
    held = deque()
    while True:
        with suppress(OSError):
            if len(held) < MANY:
                held.append(connected(url))
                held[-1].sendall(first)
                held[-1].setblocking(False)
        if len(held) == MANY:
            time.sleep(1.0 / MANY)
            connection = held.popleft()
            try:
                connection.send(more)
                held.append(connection)
            except BlockingIOError:
                held.append(connection)
            except OSError:  # it was cut
                connection.close()


ATTACKS = {
    "an endless header": (endless, HEAD + b"x: ", b"a"),
    "an endless URL": (endless, b"GET /", b"a"),
    f"{MANY} that do not read": (many, 16 * MESH, b"\r\n"),
    f"{MANY} that are slow": (many, HEAD, b"x"),
}
"""What does it, and what it sends, first and then."""


def attack(how, *sent):
    os.nice(10)
    how(*sent)


@contextmanager
def attacked(*how):
    """Attack a service from a process of its own."""
    process = get_context("spawn").Process(target=attack, args=how, daemon=True)
    process.start()
    try:
        time.sleep(3.0)
        yield
    finally:
        process.kill()
        process.join()


class Found(NamedTuple):
    """What was found in a time; latencies are from when a frame was due to its reply."""

    p50_us: float
    p99_us: float
    max_us: float
    memory_mb: float  # the most
    health_ms: float  # the longest
    statuses: str  # of /health, with their numbers


def timed(session, rate, seconds):
    """Latencies (n,) µs of the frames of a circle in the tissue."""
    centre = np.array(session.greeting["example"]["position"])
    latencies, start = [], time.perf_counter()
    for number in range(int(rate * seconds)):
        due = start + number / rate
        while (wait := due - time.perf_counter()) > 0.0:
            time.sleep(wait)
        angle = 2.0 * np.pi * number / rate
        session.step(centre + 0.1 * np.array([np.cos(angle), np.sin(angle), 0.0]))
        latencies.append(1e6 * (time.perf_counter() - due))
    return np.array(latencies)


def observed(session, server, rate, seconds):
    """Time a session and the service's health, and read its memory."""
    over, memory, health, statuses = threading.Event(), [], [], Counter()

    def watch():
        while not over.wait(0.1):
            memory.append(1e-6 * process_memory(server.process.pid))
            start = time.perf_counter()
            try:
                with connected(server.url) as connection:
                    connection.sendall(HEAD + b"connection: close\r\n\r\n")
                    statuses[connection.recv(4096)[9:12].decode()] += 1
            except OSError as error:
                statuses[type(error).__name__] += 1
            health.append(1e3 * (time.perf_counter() - start))

    watching = threading.Thread(target=watch)
    watching.start()
    latencies = timed(session, rate, seconds)
    over.set()
    watching.join()
    told = ", ".join(f"{number} x {status}" for status, number in statuses.items())
    quantiles = np.percentile(latencies, [50, 99, 100]).tolist()
    return Found(*quantiles, max(memory), max(health), told)


@click.command()
@click.argument("artifact", type=click.Path(exists=True, path_type=Path))
@click.option("--seconds", default=20.0)
@click.option("--rate", default=1000.0, help="Frames per second; fewer where alone it is behind.")
@click.option("--only", default="", help="Attacks whose names contain this.")
def main(artifact, seconds, rate, only):
    """Print what was found alone and beside each attack."""
    print(f"{'':29}" + "".join(f"{name:>11}" for name in Found._fields))
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / artifact.name).symlink_to(artifact.resolve())
        for name, (how, first, more) in ATTACKS.items():
            if only not in name:
                continue
            os.sched_setaffinity(0, CORES)
            server = Server(folder)
            os.sched_setaffinity(server.process.pid, CORES[-1:])
            os.sched_setaffinity(0, CORES[:1])
            with Client(server.url) as client:
                scene = client.scenes()["scenes"][0]["name"]
            with Session(server.url, scene) as session:
                with suppress(PermissionError):
                    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), -5)
                timed(session, rate, 1.0)
                show("alone", observed(session, server, rate, seconds))
                first = first.replace(b"%b", scene.encode())
                with attacked(how, server.url, first, more):
                    show(f"beside {name}", observed(session, server, rate, seconds))
            server.stop()
            assert "Traceback" not in server.log


def show(name, found):
    *numbers, last = found
    print(f"{name:29}" + "".join(f"{number:11.1f}" for number in numbers) + f"  {last}", flush=True)


if __name__ == "__main__":
    main()
