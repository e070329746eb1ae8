"""Waits for what a live system does in its own time."""

from __future__ import annotations

import time
from collections.abc import Callable


def wait_for(truth: Callable[[], bool], timeout_s: float = 20.0) -> bool:
    """Return True as soon as it is so; False if it is not in time."""
    deadline = time.monotonic() + timeout_s
    while not truth():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True
