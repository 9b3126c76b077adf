"""Tasks on many cores, and their results on disk, so that a killed run goes on where it stopped.

A task is a function of a ``FullProblem`` with its further arguments, which are picklable; a path
among them is that of a stored result.  Any executor with the ``concurrent.futures`` interface can
run it, if ``open_scene`` or ``open_artifact`` initializes its workers, or in ``OnScene``; on other
machines those of ``run.cluster`` do.

Each result is a file of its own, written aside and moved into place: whatever the moment of
a kill, a result is there or it is not.  It begins with a hash of the rest, so a damaged one is seen
and made anew.  The folder is named by a hash of everything the results depend on, so stale ones are
never read, and belongs to one process at a time.
"""

import hashlib
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, Self

from tqdm import tqdm

from palpate.offline.bodies import base, places, regions
from palpate.offline.fem.problem import FullProblem
from palpate.offline.fem.section import read_section
from palpate.shared.anatomy import FileBody
from palpate.shared.errors import PalpateError
from palpate.shared.files import write_whole
from palpate.shared.scene import Extrusion, Scene, parse_scene

Tasks = Mapping[str, tuple[Any, ...]]

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

MEMORY = ":".join(
    f"glibc.malloc.{name}"
    for name in ("mmap_threshold=4294967296", "trim_threshold=4294967296", "hugetlb=1")
)
"""``GLIBC_TUNABLES`` with which processes use memory again that they have freed, in large pages.

As they are they give large arrays back to the system, which clears the pages of the next ones: a
local model of ``turbinate-mri`` takes 2.9 instead of 4.3 seconds."""

CODE = ("offline", "shared")
LIBRARIES = ("numpy", "scipy", "numba", "mkl")
"""What answers depend on to the last bit, beside ``CODE``."""

_problem: FullProblem | None = None
_scene = ""
"""Key of the ``Job`` that the problem is of."""

_at_work = threading.Lock()


def _belong_to_parent() -> None:
    """Leave interrupts to the process that started this worker, and end when that is killed."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def open_scene(text: str, folder: str) -> None:
    """Initialize a worker process on a scene, given by its text and where its files lie."""
    global _problem
    _belong_to_parent()
    _problem = FullProblem(parse_scene(text, Path(folder)))


def open_artifact(path: Path, young: float | None = None) -> None:
    """Initialize a worker process on the mesh of an artifact; see ``FullProblem.of_artifact``."""
    global _problem
    _belong_to_parent()
    _problem = FullProblem.of_artifact(path, young)


def run(task: Callable[..., object], *args: object) -> object:
    """Run ``task(problem, *args)`` in a worker."""
    return task(_problem, *args)


@cache
def versions() -> dict[str, str]:
    """Hash of the code of this process, as it was when first asked for, and its libraries."""
    sha = hashlib.sha256()
    for package in CODE:
        for source in sorted((Path(__file__).parents[2] / package).rglob("*.py")):
            sha.update(source.read_bytes())
    found = {"palpate": sha.hexdigest()[:16], "python": "{}.{}".format(*sys.version_info)}
    for name in LIBRARIES:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def other_versions(wanted: dict[str, str]) -> str:
    """Which of the ``versions`` here are not those wanted; nothing if all are."""
    own = versions()
    names = (name for name in wanted | own if own.get(name) != wanted.get(name))
    return ", ".join(f"{name} {own.get(name)} and not {wanted.get(name)}" for name in names)


class Job(NamedTuple):
    """What a worker needs to open a scene."""

    key: str  # of the scene, its files and the code
    text: str
    folder: str  # where its files lie
    versions: dict[str, str]

    @classmethod
    def of(cls, scene: Scene, key: str) -> Self:
        """The training of a scene by this very code."""
        return cls(key, scene.text, str(scene.folder), versions())


def on_job(job: Job, function: Callable[..., Any], *args: Any) -> Any:
    """Run a function in a worker, once that has the problem of a job.

    Raises
    ------
    PalpateError
        If the worker has other code or libraries, or runs another task.
    """
    global _problem, _scene
    if other := other_versions(job.versions):
        raise PalpateError(f"a worker is refused, since it has {other}")
    if not _at_work.acquire(blocking=False):
        raise PalpateError("executor: its workers must be processes of one thread each")
    try:
        if _scene != job.key:
            _problem, _scene = FullProblem(parse_scene(job.text, Path(job.folder))), job.key
        return function(*args)
    finally:
        _at_work.release()


class OnScene(Executor):
    """Somebody's executor, whose workers open a scene with their first task.

    They must be processes of one thread each that read files where this one does.
    """

    def __init__(self, executor: Executor, scene: Scene, key: str) -> None:
        self._executor, self._job = executor, Job.of(scene, key)

    def submit(self, function: Callable[..., Any], /, *args: Any, **_: Any) -> Future[Any]:
        """See ``Executor``; it is not shut down."""
        return self._executor.submit(on_job, self._job, function, *args)


def worker_pool(
    initializer: Callable[..., None], *args: object, count: int | None = None
) -> ProcessPoolExecutor:
    """Processes that start with ``initializer(*args)``; as many as cores unless ``count`` is given.

    A worker is one thread: its parallelism is that of the tasks.  An interrupt from the keyboard is
    left to this process, which stops the workers when they have done their tasks.
    """
    os.environ.update(dict.fromkeys(THREADS, "1"), GLIBC_TUNABLES=MEMORY)
    count = count or os.cpu_count() or 1
    pool = ProcessPoolExecutor(
        count,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=initializer,
        initargs=args,
    )
    with _deaf_children():
        for _ in range(count):  # each starts one, since none has done anything yet
            pool.submit(os.getpid)
    return pool


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Let processes that begin now hear no interrupt; only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)  # which they inherit
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, interrupt)


def files_of(scene: Scene) -> dict[str, bytes]:
    """Content of the files that a scene names, if they are at hand, by their names in it.

    With the stored mesh of a body from a file.
    """
    geometry, folder, files = scene.geometry, scene.folder, dict[str, bytes]()
    if folder is None:
        return files
    if isinstance(geometry, Extrusion):
        files[geometry.section] = read_section(folder / geometry.section)
    paths = [path for at in (scene.support, scene.surface) for path in places.files_of(scene, at)]
    paths += regions.files_of(scene)
    if isinstance(geometry, FileBody):
        base.base_mesh(scene)
        paths += [base.body_file(scene)[1], base.stored_at(scene)]
    return files | {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def content_key(scene: Scene) -> str:
    """Hash of the scene, the files it names and the code that trains it."""
    parts = scene.text.encode(), *files_of(scene).values(), versions()["palpate"].encode()
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


class Checkpoint:
    """Named results of one training run, in the folder where runs of this artifact keep theirs.

    The key is from ``content_key``; results of other keys are removed.  ``told`` is called with a
    title, the number of its tasks that are done, and of all.  Raises ``PalpateError`` if another
    process works there.  As a context it is removed at the end, and left where that fails.
    """

    def __init__(
        self, folder: Path, key: str, told: Callable[[str, int, int], None] = lambda *_: None
    ) -> None:
        self.key, self._told = key, told
        self._parent = folder
        self._folder = folder / key
        self._folder.mkdir(parents=True, exist_ok=True)
        self._unlock = weakref.finalize(self, os.close, _locked(folder / "lock"))
        for other in folder.iterdir():
            if other.is_dir() and other != self._folder:
                shutil.rmtree(other)
        for left in self._folder.glob("*.part"):  # by a process that was killed
            left.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        if failure is None:
            self.remove()
        else:
            self.leave()

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.pickle"

    def __contains__(self, name: str) -> bool:
        path = self._path(name)
        try:
            _checked(path)
        except FileNotFoundError:
            return False
        except PalpateError as damaged:
            tqdm.write(f"{damaged}; it is made anew", file=sys.stderr)
            path.unlink()
            return False
        return True

    def load(self, name: str) -> Any:
        """Read a result that is there."""
        return read_result(self._path(name))

    def store(self, name: str, result: object) -> Path:
        """Keep a result; return where, for workers to read it with ``read_result``."""
        path, pickled = self._path(name), pickle.dumps(result)
        write_whole(path, hashlib.sha256(pickled).digest(), pickled)
        return path

    def resume(self, title: str, executor: Executor, tasks: Tasks) -> dict[str, Any]:
        """Results of tasks by name; those that are not there yet are run, with a bar."""
        missing = {
            executor.submit(run, *task): name for name, task in tasks.items() if name not in self
        }
        done = len(tasks) - len(missing)
        self._told(title, done, len(tasks))
        try:
            for future in tqdm(as_completed(missing), title, len(tasks), initial=done):
                self.store(missing[future], future.result())
                done += 1
                self._told(title, done, len(tasks))
        except BrokenProcessPool as error:
            raise PalpateError(
                f"{title}: a worker was killed, most likely since memory ran out; what is done is "
                "kept: start again, with fewer --workers"
            ) from error
        finally:
            for future in missing:
                future.cancel()
        return {name: self.load(name) for name in tasks}

    def remove(self) -> None:
        """Forget everything: the artifact is written."""
        shutil.rmtree(self._parent)
        self._unlock()

    def leave(self) -> None:
        """Let others work here; what nobody can go on from goes."""
        if self._folder.is_dir() and not any(self._folder.iterdir()):
            shutil.rmtree(self._parent)
        self._unlock()


def read_result(path: Path) -> Any:
    """Result that a ``Checkpoint`` stored; raise ``PalpateError`` if it is damaged."""
    return pickle.loads(_checked(path))


def _checked(path: Path) -> memoryview:
    """What is pickled in a file, if it is as it was written."""
    content = memoryview(path.read_bytes())
    if hashlib.sha256(content[32:]).digest() != content[:32]:
        raise PalpateError(f"{path} is damaged")
    return content[32:]


def _locked(path: Path) -> int:
    """Descriptor of a file that is this process's until it is closed, as when the process ends."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        import fcntl
    except ImportError:  # no POSIX
        return descriptor
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        other = os.read(descriptor, 1000).decode(errors="replace").strip() or "another process"
        os.close(descriptor)
        raise PalpateError(
            f"{path.parent} is in use by {other}; wait for it to end, or choose another --out"
        ) from None
    os.truncate(descriptor, 0)
    with suppress(OSError):  # where the disk is full it is locked all the same
        os.write(descriptor, f"process {os.getpid()}: {' '.join(sys.argv)}\n".encode())
    return descriptor
