import asyncio
import os
import subprocess
import sys

import pytest

from palpate.online.session import realtime

ENTER = """
import os
from palpate.online.session import realtime
before = os.sched_getscheduler(0) if hasattr(os, "sched_getscheduler") else None
print(realtime.enter())
if before is not None:
    print(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO)
"""


def run(script):
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


def test_it_says_what_the_system_granted():
    said, *fifo = run(ENTER)
    assert said.startswith("real-time scheduling: ")
    assert "memory lock: " in said
    if fifo:  # it must not claim more than what is so
        assert ("real-time scheduling: on" in said) == (fifo == ["True"])


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="not known to this system")
def test_a_refusal_is_told_with_what_it_takes(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    said = realtime._schedule()
    assert "refused (Operation not permitted)" in said
    assert "CAP_SYS_NICE" in said


def go_on(vigil, seconds, stride, cost):
    """Let time pass in strides; return the share of a core spent, `cost` a stride when awake."""
    now = spent = 0.0
    vigil._until = seconds
    while now < seconds:
        awake = vigil._may_go_on(now, spent)
        now += stride
        spent += stride if awake else cost
    return spent / seconds


@pytest.mark.parametrize("cost", [0.0, 5e-5])
def test_a_worker_that_waits_awake_still_sleeps_enough_not_to_be_halted(cost):
    share = go_on(realtime.BusyWait(1), 2.0, 1e-4, cost)
    assert 0.85 < share < 0.94  # the system halts at 0.95


@pytest.mark.parametrize(("workers", "awake"), [(0, False), (1, True), (2, False)])
def test_an_event_loop_is_kept_awake_while_frames_come(monkeypatch, workers, awake):
    """Unless nobody asked for it, or no core would be left over."""
    monkeypatch.setattr(realtime, "_cores", lambda: 2)

    async def turns():
        vigil, counted = realtime.BusyWait(workers), 0
        loop = asyncio.get_running_loop()
        run_once = loop._run_once

        def counting():
            nonlocal counted
            counted += 1
            run_once()

        loop._run_once = counting
        vigil.keep()
        await asyncio.sleep(0.2)
        during = counted
        await asyncio.sleep(0.1)
        return during, counted - during

    during, after = asyncio.run(turns())
    assert (during > 100) == awake
    assert after < 20, "without frames it sleeps again"
