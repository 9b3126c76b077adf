"""Tasks on many cores: worker processes with a full model each, results as they come.

A task is a function of a ``FullProblem`` with its further arguments, which are picklable.  Any
executor with the ``concurrent.futures`` interface can run it, if ``open_scene`` or
``open_artifact`` initializes its workers.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tqdm import tqdm

from palpate.offline.fem.problem import FullProblem
from palpate.offline.run.checkpoint import Checkpoint
from palpate.shared.artifact import read_artifact
from palpate.shared.scene import parse_scene

Tasks = Mapping[str, tuple[Any, ...]]

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


_problem: FullProblem | None = None


def _end_with_parent() -> None:
    """Stop this worker when the process that started it is killed."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def open_scene(text: str, folder: str) -> None:
    """Initialize a worker process on a scene, given by its text and where its files lie."""
    global _problem
    _end_with_parent()
    _problem = FullProblem(parse_scene(text, Path(folder)))


def open_artifact(path: Path) -> None:
    """Initialize a worker process on the mesh of an artifact."""
    global _problem
    _end_with_parent()
    _problem = FullProblem.of_artifact(read_artifact(path))


def run(task: Callable[..., object], *args: object) -> object:
    """Run ``task(problem, *args)`` in a worker."""
    return task(_problem, *args)


def worker_pool(
    initializer: Callable[..., None], *args: object, count: int | None = None
) -> ProcessPoolExecutor:
    """Processes that start with ``initializer(*args)``; as many as cores unless ``count`` is given.

    A worker is one thread: its parallelism is that of the tasks.
    """
    os.environ.update(dict.fromkeys(THREADS, "1"))
    return ProcessPoolExecutor(
        count or os.cpu_count(),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=initializer,
        initargs=args,
    )


def completed(
    executor: Executor, tasks: Tasks, names: Iterable[str] | None = None
) -> Iterator[tuple[str, Any]]:
    """Run tasks, all or those named; yield name and result of each as soon as it is done."""
    futures = {
        executor.submit(run, *tasks[name]): name for name in (tasks if names is None else names)
    }
    try:
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        for future in futures:
            future.cancel()


def resume(title: str, executor: Executor, checkpoint: Checkpoint, tasks: Tasks) -> dict[str, Any]:
    """Results of tasks by name; those that are not in the checkpoint yet are run, with a bar."""
    missing = [name for name in tasks if name not in checkpoint]
    with tqdm(total=len(tasks), initial=len(tasks) - len(missing), desc=title) as bar:
        for name, result in completed(executor, tasks, missing):
            checkpoint.store(name, result)
            bar.update()
    return {name: checkpoint.load(name) for name in tasks}
