"""Real time: the worker runs before all ordinary work of the machine, and waits for frames awake.

On a busy machine the scheduler lets a ready worker wait for milliseconds; with a first-in-first-out
priority it runs at once. Linux grants this to root, to CAP_SYS_NICE, or within the limit
``rtprio`` of limits.conf (``LimitRTPRIO`` of systemd), and keeps 5 % of each core for the rest of
the world: a worker that never sleeps is halted for 50 ms every second.

Waking up takes a worker some 80 µs, as long as all the rest of its work on a frame. While frames
come, an event loop with a `BusyWait` does not sleep, but for a little more than would halt it.
It takes a core that is left over: not the last one, which the client may need.
"""

import asyncio
import ctypes
import os
from time import perf_counter, thread_time

PRIORITY = 10
"""Above all ordinary work, below the kernel's own threads (50)."""

LINGER = 0.02
"""Seconds after a frame that the next one is waited for awake."""

AWAKE = 0.92
"""Share of a core that a worker takes at most by waiting."""

SPREE = 1e-3
"""Seconds of a core that it may be ahead of its share."""

_MCL_CURRENT, _MCL_ONFAULT = 1, 4  # Linux: what is in memory, not all that could be


def enter() -> str:
    """Ask for real-time scheduling of this thread and for memory that is never swapped out.

    Call it when the models are warm: what is in memory by then is what answers need. Threads and
    processes made later are ordinary. Returns a sentence that says what the system granted.
    """
    return f"{_schedule()}; {_lock_memory()}"


def _schedule() -> str:
    if not hasattr(os, "sched_setscheduler"):
        return "real-time scheduling: not known to this system"
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    except OSError as error:
        return (
            f"real-time scheduling: refused ({error.strerror}), running as ordinary work; it takes "
            f"root, CAP_SYS_NICE or an rtprio limit of {PRIORITY}"
        )
    return f"real-time scheduling: on (SCHED_FIFO, priority {PRIORITY})"


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _lock_memory() -> str:
    mlockall = getattr(ctypes.CDLL(None, use_errno=True), "mlockall", None)
    if mlockall is None:
        return "memory lock: not known to this system"
    if mlockall(_MCL_CURRENT | _MCL_ONFAULT) != 0:
        return (
            f"memory lock: refused ({os.strerror(ctypes.get_errno())}); it takes root, "
            "CAP_IPC_LOCK or a higher memlock limit"
        )
    return "memory lock: on"


class BusyWait:
    """Keeps an event loop from sleeping while frames come.

    It does so if each of the `workers` can have a core, and one is left over.
    """

    def __init__(self, workers: int) -> None:
        self._enabled = 0 < workers < _cores()
        self._awake = False
        self._until = self._looked = self._spent = self._ahead = 0.0

    def keep(self) -> None:
        """Stay awake for the frame after the one that has just come."""
        if not self._enabled:
            return
        self._until = perf_counter() + LINGER
        if not self._awake:
            self._awake = True
            self._watch(asyncio.get_running_loop())

    def _watch(self, loop: asyncio.AbstractEventLoop) -> None:
        self._awake = self._may_go_on(perf_counter(), thread_time())
        if self._awake:
            loop.call_soon(self._watch, loop)  # a loop with something to do does not sleep

    def _may_go_on(self, now: float, spent: float) -> bool:
        """Tell at a time whether to go on, the thread having spent so many seconds of its core."""
        ahead = self._ahead + (spent - self._spent) - AWAKE * (now - self._looked)
        self._ahead, self._looked, self._spent = max(ahead, 0.0), now, spent
        return now < self._until and self._ahead < SPREE
