"""What a page asks of the hand, as messages to the simulator."""

from __future__ import annotations

import time
from collections.abc import Callable

from services.simulator.physics.led_hand import PUSH_EXPIRES_S
from shared.bus.messages import HandLead
from tools.view.source import Order

SOURCE = "xrl view"


class HandOrders:
    """Puts orders to lead and orders to push together: each message has both."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._led: tuple[float, float] | None = None
        self._force = (0.0, 0.0, 0.0)
        self._pushed_s = -PUSH_EXPIRES_S

    def message(self, order: Order) -> HandLead:
        """Return the message of a `hand` or `push` order; its stamp is for the sender."""
        now_s = self._clock()
        if order.order == "push":
            self._force, self._pushed_s = order.force, now_s
        else:
            self._led = (order.height, order.pitch)
        lasts = now_s - self._pushed_s < PUSH_EXPIRES_S
        height, pitch = self._led or (0.0, 0.0)
        return HandLead(
            t_ns=0,
            seq=0,
            leads=self._led is not None,
            height=height,
            pitch=pitch,
            push=self._force if lasts else (0.0, 0.0, 0.0),
            source=SOURCE,
        )
