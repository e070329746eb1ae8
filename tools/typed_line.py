"""What a person types while a program goes on."""

from __future__ import annotations

import select
import sys
import time


def typed_line(wait_s: float) -> str | None:
    """Return the line that a person enters within a time, s; None: none, "": the terminal is gone.

    Without a terminal there is nobody to enter one.
    """
    if not sys.stdin.isatty():
        time.sleep(wait_s)
        return None
    return sys.stdin.readline() if select.select([sys.stdin], [], [], wait_s)[0] else None
