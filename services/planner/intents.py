"""What the person asks for, for as long as it is heard (`operator/intent`). Pure.

An intent that is not said again goes stale: who asked for 100 N and has gone is not to be lifted
for ever. It fades out slowly, for somebody may still lean on it:

    wish = intent                                       younger than `assist.stale_ms`
    wish = intent max(0, 1 - (age - stale) / fade)      older
"""

from __future__ import annotations

import math
from typing import NamedTuple

from shared.clock import NS_PER_MS, NS_PER_S
from shared.config_sections import AssistConfig
from shared.messages import STRAIGHT, OperatorIntent, Vector4


class Wish(NamedTuple):
    """What the planner is to give."""

    assist_n: float = 0.0
    shift: Vector4 = STRAIGHT
    """x, y in m; roll, yaw in rad."""
    source: str = ""
    """Who asks; "": nobody does, or no longer."""


class Intents:
    """Keeps the newest intent, and lets it fade once it is stale."""

    def __init__(self, config: AssistConfig) -> None:
        """Take how soon an intent is stale, and how fast it then fades."""
        self._stale_ns = round(config.stale_ms * NS_PER_MS)
        self._fade_ns = round(config.fade_s * NS_PER_S)
        self._wish = Wish()
        self._heard_ns = 0

    def receive(self, intent: OperatorIntent, now_ns: int) -> None:
        """Take an intent that has arrived; one that holds what is no number is none."""
        if all(map(math.isfinite, (intent.assist_n, *intent.shift))):
            self._wish = Wish(intent.assist_n, intent.shift, intent.source)
            self._heard_ns = now_ns

    def wish(self, now_ns: int) -> Wish:
        """Return what is asked for now."""
        late_ns = now_ns - self._heard_ns - self._stale_ns
        if late_ns <= 0:
            return self._wish
        share = max(0.0, 1.0 - late_ns / self._fade_ns)
        x, y, roll, yaw = self._wish.shift
        shift = share * x, share * y, share * roll, share * yaw
        return Wish(share * self._wish.assist_n, shift)
