"""A planner goes on from its state bit for bit."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from services.planner.intents import OperatorRequest
from services.planner.planner import Planner, PlannerState
from shared.arrays import Array
from shared.bus.messages import DriveStatus, Mode
from tests.planner.states import ROBOT, SESSION, START_NS, TICK_NS, closed, receive_all


def astray(q: Array) -> Array:
    return q + 1e-2 * np.random.default_rng(4).normal(size=12)


COURSES: dict[str, dict[str, Any]] = {
    "a module that stays disarmed": {"mode": int(Mode.DISARMED), "drive": int(DriveStatus.IDLE)},
    "another planner that leads": {"session": 99},
    "feet astray": {},
}


@pytest.mark.parametrize("name", COURSES)
def test_a_planner_goes_on_bit_for_bit(name: str) -> None:
    """It goes on counting, with the wish, the stance and the rival that it had."""
    changes, q = COURSES[name], closed(1.188, x=0.01, pitch=0.1)
    q = astray(q) if name == "feet astray" else q
    planner, twin = Planner(ROBOT, SESSION), Planner(ROBOT, SESSION)
    planner.receive_request(OperatorRequest(0.0, (0.01, 0.0, 0.0, 0.02)))
    seen = []
    for tick in range(60):
        if tick == 40:
            text = msgspec.json.encode(planner.state)
            twin.state = msgspec.json.decode(text, type=PlannerState)
        now_ns = START_NS + tick * TICK_NS
        both = []
        for each in (planner, twin) if tick >= 40 else (planner,):
            receive_all(each, q, now_ns, seq=tick, **changes)
            both.append((each.tick(now_ns), each.status(now_ns, 0.0)))
        assert both[0] == both[-1]
        seen.append(both[0])
    status = seen[-1][1]
    assert status.shift_requested == (0.01, 0.0, 0.0, 0.02)
    if name == "a module that stays disarmed":
        assert [seen[40][0][0].stiffen, seen[-1][0][0].stiffen] == [False, True]
    elif name == "another planner that leads":
        assert "99" in status.why
    else:
        assert math.hypot(*status.stance[:3]) > 1e-3
