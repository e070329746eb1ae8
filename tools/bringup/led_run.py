"""A live robot that is asked for something for a while, to identify its body and to tune it."""

from __future__ import annotations

import time
from collections.abc import Callable

from shared.clock import NS_PER_S, now_ns
from tools.fleet.led_planner import LedPlanner


def run_led(
    planner: LedPlanner,
    duration_s: float,
    ask: Callable[[float], None],
    listen: Callable[[], None],
    stopped: Callable[[], bool],
    *,
    every_s: float,
) -> str:
    """Ask for what is wanted at a time, s, again and again, and listen ten times as often.

    Whatever ends it, nothing is asked for any more, and what was asked for fades out.

    Returns:
        Why it ended before its time; "" if it did not.
    """
    begin, ask_s, ended = now_ns(), 0.0, ""
    while not ended and (t_s := (now_ns() - begin) / NS_PER_S) < duration_s:
        if t_s >= ask_s:
            ask(t_s)
            ask_s = t_s + every_s
        listen()
        ended = "stopped" if stopped() else planner.trouble()
        time.sleep(0.1 * every_s)
    return ended
