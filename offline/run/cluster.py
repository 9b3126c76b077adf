"""Tasks on a cluster of dask.distributed, whose workers come and go and share no disk with us.

A worker gets the scene, the files that it names and the results that tasks read as files of its
own; plugins of dask give them to workers that come later, too.  Only a few tasks for each worker
are sent at a time, so that few are lost with it and little of what they need waits at the
scheduler.  Lost ones are sent again; where the scheduler itself is lost and does not come back,
the cores of this machine do what is left.
"""

import json
import logging
import os
import pickle
import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Executor, Future
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import distributed
from distributed import Client, KilledWorker, Worker, WorkerPlugin
from distributed.client import ClosedClientError
from tqdm import tqdm

from palpate.offline.run.workers import (
    THREADS,
    Job,
    files_of,
    on_job,
    open_scene,
    other_versions,
    worker_pool,
)
from palpate.shared.errors import PalpateError
from palpate.shared.files import write_whole
from palpate.shared.scene import Scene, SceneError

ANSWERS = 10.0
"""Seconds within which a scheduler answers."""

RETURNS = 60.0
"""Seconds for which a scheduler that was lost is waited for."""

SENT = 2
"""Tasks that are sent at a time for each worker: the one that it does, and the next."""

DEATHS = 3
"""How many times a task is sent again that the scheduler gave up, since workers died with it."""

RECOUNTED = 2.0
"""Seconds after which workers are counted again."""

LOST = OSError, ClosedClientError, CancelledError
"""What is raised where the scheduler is gone."""

DEADLY = "one task ended several workers in a row: have they enough memory?"

_given: dict[str, tuple[Job, Path]] = {}
"""Jobs whose files this process, a worker, has, and the folder of their results, by their keys."""


class Unready(Exception):
    """A worker has not got the files of a job yet."""


class JobFiles(WorkerPlugin):
    """Gives workers a scene, and the files that it names by their relative names."""

    def __init__(self, job: Job, files: dict[str, bytes]) -> None:
        self.name = _name(job.key)
        self._job, self._files = job, files

    def setup(self, worker: Worker) -> None:
        """Write the files among the worker's own."""
        folder = Path(worker.local_directory, self.name)
        scene = write_files(self._files, folder / "scene")
        _given[self._job.key] = self._job._replace(folder=str(scene)), folder

    def teardown(self, worker: Worker) -> None:
        """Remove them, and the results beside them."""
        _given.pop(self._job.key, None)
        shutil.rmtree(Path(worker.local_directory, self.name), ignore_errors=True)


class ResultFile(WorkerPlugin):
    """Gives workers a result of a job that tasks read."""

    def __init__(self, key: str, path: Path) -> None:
        self.name = _name(key, path)
        self._folder, self._file, self._content = _name(key), path.name, path.read_bytes()

    def setup(self, worker: Worker) -> None:
        """Write it among the worker's files."""
        folder = Path(worker.local_directory, self._folder)
        folder.mkdir(exist_ok=True)
        write_whole(folder / self._file, self._content)


def _name(key: str, result: Path | None = None) -> str:
    """Name of what workers are given of a job."""
    return f"palpate-{key}" if result is None else f"palpate-{key}-{result.name}"


def write_files(files: dict[str, bytes], folder: Path) -> Path:
    """Write files in a folder, or below; return where their relative names start from."""
    up = max((Path(name).parts.count("..") for name in files), default=0)
    start = folder.joinpath(*["scene"] * up)
    start.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        path = Path(os.path.normpath(start / name))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return start


def refusal(wanted: dict[str, str], dask_worker: Worker) -> str | None:
    """Why this worker does nothing for a client of these ``versions``; None if it does."""
    if other := other_versions(wanted):
        return f"it has {other}; install there what is here and start it again"
    threads = dask_worker.state.nthreads
    if threads != 1:
        return f"it has {threads} threads; start it with --nthreads 1, and --nworkers for its cores"
    shared = [name for name in THREADS if os.environ.get(name) != "1"]
    return f"it has {shared[0]} other than 1; start it without" if shared else None


def on_worker(key: str, pickled: bytes) -> bytes:
    """Do a task of a job; pickled, so that dask neither looks into it nor copies it."""
    if key not in _given:
        raise Unready
    job, results = _given[key]
    refused = refusal(job.versions, distributed.get_worker())
    if refused:
        raise PalpateError(f"{distributed.get_worker().address}: {refused}")
    function, args = pickle.loads(pickled)
    own = [results / arg.name if isinstance(arg, Path) else arg for arg in args]
    return pickle.dumps(on_job(job, function, *own))


class _Task:
    """A task that somebody waits for."""

    def __init__(self, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
        self.function, self.args = function, args
        self.future: Future[Any] = Future()
        self.sent: Any = None  # future of dask, or of the processes here
        self.deaths = 0


class Cluster(Executor):
    """Workers of a scheduler, initialized on a scene.

    Paths among the arguments of a task are results that are stored here, for the task to read.

    Parameters
    ----------
    scheduler : str
        Address, such as ``tcp://host:8786``, or the file that the scheduler wrote.
    scene : Scene
    key : str
        Of the scene, its files and the code; see ``content_key``.

    Raises
    ------
    PalpateError
        If there is no such scheduler, or a worker must not take part; see ``refusal``.
    """

    def __init__(self, scheduler: str, scene: Scene, key: str) -> None:
        self._scheduler = scheduler
        self._job, self._files = Job.of(scene, key), files_of(scene)
        for name in self._files:
            if Path(name).is_absolute():
                raise SceneError(f"{name}: workers elsewhere need a name relative to the scene's")
        self._lock, self._ended = threading.RLock(), threading.Event()
        self._waiting: deque[_Task] = deque()
        self._running: dict[_Task, None] = {}
        self._results: list[Path] = []  # that workers have
        self._pool: Executor | None = None
        self._count, self._counted = 0, -RECOUNTED
        for name in ("distributed", "distributed.client"):  # what matters is said here
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            self._client = self._connected()
        except OSError as error:
            raise PalpateError(f"{scheduler}: no scheduler answers there ({error})") from error

    def submit(self, function: Callable[..., Any], /, *args: Any, **_: Any) -> Future[Any]:
        """See ``Executor``."""
        task = _Task(function, args)
        with self._lock:
            self._waiting.append(task)
            self._fill()
        return task.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster, whose workers stay; see ``Executor``."""
        self._ended.set()
        with self._lock:
            if self._pool:
                self._pool.shutdown(wait, cancel_futures=cancel_futures)
                return
            with suppress(*LOST, ValueError):
                for result in (*self._results, None):
                    self._client.unregister_worker_plugin(_name(self._job.key, result))
            self._client.close(ANSWERS)

    @property
    def workers(self) -> int:
        """Worker processes that there are, or were last."""
        if time.monotonic() - self._counted > RECOUNTED:
            with suppress(*LOST):
                self._count = len(self._client.nthreads())
            self._counted = time.monotonic()
        return self._count

    # --- tasks; under the lock -----------------------------------------------------------------

    def _fill(self) -> None:
        """Send as many of the waiting tasks as there should be at the workers."""
        while self._waiting and (self._pool or len(self._running) < SENT * max(1, self.workers)):
            task = self._waiting.popleft()
            if not (task.future.running() or task.future.set_running_or_notify_cancel()):
                continue
            self._running[task] = None
            try:
                self._send(task)
            except LOST:
                self._renew()

    def _send(self, task: _Task) -> None:
        """Send a task, after the results that it reads."""
        if self._pool:
            task.sent = self._pool.submit(task.function, *task.args)
        else:
            for path in task.args:
                if isinstance(path, Path) and path not in self._results:
                    self._client.register_plugin(ResultFile(self._job.key, path))
                    self._results.append(path)
            pickled = pickle.dumps((task.function, task.args))
            task.sent = self._client.submit(on_worker, self._job.key, pickled, pure=False)
        task.sent.add_done_callback(partial(self._done, task))

    def _done(self, task: _Task, sent: Any) -> None:
        """Take what came of a task; in a thread of dask, which does this for one at a time."""
        of_dask, value, error = isinstance(sent, distributed.Future), None, None
        try:
            value = pickle.loads(sent.result()) if of_dask else sent.result()
        except BaseException as raised:
            error = raised
        lost = of_dask and isinstance(error, LOST) and sent.status != "error"
        died = isinstance(error, KilledWorker | Unready)
        with self._lock:
            if task.sent is not sent or self._ended.is_set():  # it was sent again, or is not wanted
                return
            try:
                if lost:
                    self._renew()
                else:
                    del self._running[task]
                    if died and task.deaths < DEATHS:
                        task.deaths += 1
                        self._waiting.appendleft(task)
                    else:
                        self._settle(task, value, PalpateError(DEADLY) if died else error)
                self._fill()
            except Exception as refused:
                for left in (*self._running, *self._waiting):
                    self._settle(left, None, refused)

    @staticmethod
    def _settle(task: _Task, value: object, error: BaseException | None) -> None:
        if task.future.cancelled():
            return
        if error is None:
            task.future.set_result(value)
        else:
            task.future.set_exception(error)

    # --- the scheduler -------------------------------------------------------------------------

    def _connected(self) -> Client:
        """Client of the scheduler whose workers have what they need."""
        client = Client(_address(self._scheduler), timeout=ANSWERS, set_as_default=False)
        try:
            if not client.nthreads():
                self._say("there is no worker yet; waiting for one")
            while not client.nthreads() and not self._ended.wait(1.0):
                pass
            for address, refused in client.run(refusal, self._job.versions).items():
                if refused:
                    raise PalpateError(f"worker {address} is refused: {refused}")
            client.register_plugin(JobFiles(self._job, self._files))
            for path in self._results:
                client.register_plugin(ResultFile(self._job.key, path))
        except ImportError as error:
            client.close()
            raise PalpateError(
                f"{self._scheduler}: a worker lacks what is here: {error}; install it there"
            ) from error
        except BaseException:
            client.close()
            raise
        return client

    def _renew(self) -> None:
        """Find the scheduler again, or go on without; what was sent waits to be sent again."""
        self._say(f"the scheduler is gone; waiting {RETURNS:.0f} s for it to come back")
        with suppress(*LOST):
            self._client.close(1.0)
        self._waiting.extendleft(reversed(self._running))
        self._running.clear()
        last = time.monotonic() + RETURNS
        while not self._ended.wait(1.0):
            try:
                self._client = self._connected()
            except OSError:
                if time.monotonic() < last:
                    continue
                self._pool = worker_pool(open_scene, self._job.text, self._job.folder)
            where = (
                "on the cores of this machine" if self._pool else "with the scheduler, it is back"
            )
            self._say(f"goes on {where}")
            return

    def _say(self, what: str) -> None:
        tqdm.write(f"{self._scheduler}: {what}", file=sys.stderr)


def _address(scheduler: str) -> str:
    """Address of a scheduler that is given by it, or by the file that the scheduler wrote."""
    if "://" in scheduler:
        return scheduler
    try:
        return str(json.loads(Path(scheduler).read_text())["address"])
    except (ValueError, LookupError, TypeError) as error:
        raise OSError("neither an address, as tcp://host:8786, nor a scheduler's file") from error
