"""Real time: the worker runs before all ordinary work of the machine.

On a busy machine the scheduler lets a ready worker wait for milliseconds; with a first-in-first-out
priority it runs at once. Linux grants this to root, to CAP_SYS_NICE, or within the limit
``rtprio`` of limits.conf (``LimitRTPRIO`` of systemd).
"""

import ctypes
import os

PRIORITY = 10
"""Above all ordinary work, below the kernel's own threads (50)."""

_MCL_CURRENT, _MCL_ONFAULT = 1, 4  # Linux: what is in memory, not all that could be


def enter() -> str:
    """Ask for real-time scheduling of this thread and for memory that is never swapped out.

    To be called when the models are warm. Returns a sentence that says what the system granted.
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
