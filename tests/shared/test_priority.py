"""What a process may have without privilege."""

from __future__ import annotations

import subprocess
import sys

import pytest

from shared.priority import SLICE_NS, TIMER_SLACK_NS

READ_BACK = """
from pathlib import Path
from shared.priority import short_slice
print(short_slice())
print(Path("/proc/self/timerslack_ns").read_text().strip())
print([line.split(":")[1].strip() for line in Path("/proc/self/sched").read_text().splitlines()
       if line.startswith("se.slice")])
"""


def test_a_short_slice_and_exact_timers_need_no_privilege() -> None:
    granted, slack, _slice = subprocess.run(
        [sys.executable, "-c", READ_BACK], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert slack == str(TIMER_SLACK_NS)
    assert f"timer slack {TIMER_SLACK_NS} ns" in granted
    if "slice" not in granted.replace("timer slack", ""):
        pytest.skip("this kernel takes no slice by sched_setattr")
    assert f"slice {SLICE_NS} ns" in granted
