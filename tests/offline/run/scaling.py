"""Training on a cluster, measured: what a second worker is worth, what killed ones cost: a study.

    python -m tests.offline.run.scaling FOLDER pad slab --kills 10

The small first scene is trained with a worker killed at random moments, each time anew, and its
artifacts must be that of one process. The second scene is trained by one and by two workers, whose
artifacts must be the same, too; the study ends where they are not. Tables are written to
``kills.csv`` and ``stages.csv`` in the folder.
"""

import subprocess
import time
from pathlib import Path

import click
import numpy as np

from palpate.offline.run.tables import write_csv
from palpate.shared.artifact import read_artifact

from ...conftest import PALPATE
from .test_cluster import assert_same, kill_a_worker, processes


def training(scene, out, *options):
    """Start to train a scene anew."""
    command = [*PALPATE, "train", str(scene), "--out", str(out), "--force", *options]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def finish(started):
    """Wait for a training, which must not fail."""
    log = started.communicate()[1]
    assert started.returncode == 0, log


def kills(folder, scene, count, rng):
    """Train with a worker killed while it is under way, at moments of the time without."""
    alone, there, rows = folder / "alone.h5", folder / "there.h5", []
    for _ in range(2):  # the first compiles kernels
        finish(training(scene, alone, "--workers", "1"))
    with processes(folder) as running:
        begun = time.perf_counter()
        finish(training(scene, there, "--scheduler", running.file))
        whole = time.perf_counter() - begun
        while len(rows) < count:
            after, begun = float(rng.uniform(high=whole)), time.perf_counter()
            started = training(scene, there, "--scheduler", running.file)
            time.sleep(after)
            under_way = started.poll() is None
            kill_a_worker(running)
            finish(started)
            seconds = time.perf_counter() - begun
            assert_same(there, alone)
            if not under_way:
                continue
            taken = {"killed_after": after, "seconds": seconds, "without": whole}
            rows.append({name: round(value, 1) for name, value in taken.items()})
            write_csv(folder / "kills.csv", rows)
            click.echo(rows[-1])


def stages(folder, scene):
    """Tell the seconds of each stage of training by one and by two workers."""
    taken = []
    for workers in (1, 2):
        own = folder / f"{workers}"
        own.mkdir(exist_ok=True)
        with processes(own, workers=workers) as running:
            finish(training(scene, own / "there.h5", "--scheduler", running.file))
        taken.append(read_artifact(own / "there.h5").documents["training"]["seconds"])
    one, two = taken
    one["all"], two["all"] = (sum(seconds.values()) for seconds in taken)
    rows = [
        {"stage": name, "one": seconds, "two": two[name], "ratio": round(seconds / two[name], 2)}
        for name, seconds in one.items()
    ]
    write_csv(folder / "stages.csv", rows)
    for row in rows:
        click.echo(row)
    assert_same(folder / "1" / "there.h5", folder / "2" / "there.h5")


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("small")
@click.argument("large")
@click.option("--kills", "count", default=10, help="Trainings in which a worker is killed.")
@click.option("--seed", default=0, help="Of the moments.")
def main(folder, small, large, count, seed):
    """Train SMALL and LARGE scenes in a FOLDER on clusters of this machine."""
    folder.mkdir(parents=True, exist_ok=True)
    kills(folder, small, count, np.random.default_rng(seed))
    stages(folder, large)


if __name__ == "__main__":
    main()
