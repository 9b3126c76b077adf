"""Tasks on many cores: worker processes with a full model each, results as they come.

A task is a function of a ``Workshop`` with its further arguments; see ``run.workshop``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any

import numpy as np
from tqdm import tqdm

from palpate.offline.run.checkpoint import Checkpoint
from palpate.offline.run.workshop import run

Tasks = Mapping[str, tuple[Any, ...]]

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def worker_pool(
    initializer: Callable[..., None], *args: object, count: int | None = None
) -> ProcessPoolExecutor:
    """Processes that start with ``initializer(*args)``; as many as cores unless ``count`` is given.

    A worker is one thread: its parallelism is that of the tasks.
    """
    os.environ.update(dict.fromkeys(THREADS, "1"))
    return ProcessPoolExecutor(
        count or os.cpu_count(),
        mp_context=get_context("spawn"),
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


def resume(
    title: str,
    executor: Executor,
    checkpoint: Checkpoint,
    tasks: Tasks,
    pack: Callable[[Any], Mapping[str, Any]],
) -> dict[str, Any]:
    """Run the tasks whose results are not in the checkpoint yet, under a progress bar.

    Parameters
    ----------
    pack : callable
        Makes a result the arrays by name that the checkpoint keeps.

    Returns
    -------
    results : dict
        The arrays of every task by its name.
    """
    results = {name: checkpoint.load(name) for name in tasks}
    missing = [name for name, result in results.items() if result is None]
    with tqdm(total=len(tasks), initial=len(tasks) - len(missing), desc=title) as bar:
        for name, result in completed(executor, tasks, missing):
            packed = {key: np.asarray(value) for key, value in pack(result).items()}
            checkpoint.store(name, packed)
            results[name] = packed
            bar.update()
    return results
