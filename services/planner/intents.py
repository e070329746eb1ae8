"""The operator's newest intent (`operator/intent`), which fades out once stale. Pure.

An intent that is not repeated becomes stale: a request whose sender is gone must not lift the
person forever. It fades out slowly, because the person may still lean on the robot:

    request = intent                                       younger than `assist.stale_ms`
    request = intent max(0, 1 - (age - stale) / fade)      older; `sit` and `park` end at once
"""

from __future__ import annotations

import math
from typing import NamedTuple

from shared.bus.messages import STRAIGHT, OperatorIntent, Park, Vector4
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.sections import AssistConfig


class OperatorRequest(NamedTuple):
    """Operator's request: assist, shift, sit and park."""

    assist_n: float = 0.0
    shift: Vector4 = STRAIGHT
    """x, y in m; roll, yaw in rad."""
    source: str = ""
    """Name of the requester; "" without a request, or if the intent is stale."""
    sit: bool = False
    """Request to lower the robot to its lowest pose (`services.planner.law.closed_reference`)."""
    park: int = Park.AUTO
    """`Park`: request about parking, for a robot that may park (`services.planner.watch.park`)."""


class Intents:
    """Newest intent, which fades out once it is stale."""

    def __init__(self, config: AssistConfig) -> None:
        self._stale_ns = round(config.stale_ms * NS_PER_MS)
        self._fade_ns = round(config.fade_s * NS_PER_S)
        self._request = OperatorRequest()
        self._received_ns = 0

    def receive(self, intent: OperatorIntent, now_ns: int) -> None:
        """Store an intent that has arrived; ignore one with a value that is not finite."""
        if all(map(math.isfinite, (intent.assist_n, *intent.shift))):
            self._request = OperatorRequest(
                intent.assist_n, intent.shift, intent.source, intent.sit, intent.park
            )
            self._received_ns = now_ns

    def request(self, now_ns: int) -> OperatorRequest:
        """Return the present request."""
        late_ns = now_ns - self._received_ns - self._stale_ns
        if late_ns <= 0:
            return self._request
        scale = max(0.0, 1.0 - late_ns / self._fade_ns)
        x, y, roll, yaw = self._request.shift
        shift = scale * x, scale * y, scale * roll, scale * yaw
        return OperatorRequest(scale * self._request.assist_n, shift)
