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


def test_it_says_what_the_system_granted():
    run = subprocess.run([sys.executable, "-c", ENTER], capture_output=True, text=True, check=True)
    said, *fifo = run.stdout.splitlines()
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
