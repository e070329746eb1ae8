"""Waiting for what other processes and threads do."""

from __future__ import annotations

import time
from collections.abc import Callable


def comes_true(
    condition: Callable[[], object], limit_s: float = 20.0, every_s: float = 0.002
) -> bool:
    """Return True once a condition holds, looked at so often; False if it does not in time."""
    deadline = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(every_s)
    return True
