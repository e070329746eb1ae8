"""Which attitudes the planner heeds."""

from __future__ import annotations

import math

import pytest

from services.planner.planner import Planner
from shared.bus.messages import Attitude
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from tests.imu.robots import with_imu
from tests.planner.conftest import Closed
from tests.planner.test_planner import SESSION, START_NS, receive_all


def attitude(roll: float, seq: int, *, valid: bool = True) -> Attitude:
    up = (0.0, math.sin(roll), math.cos(roll))
    return Attitude(t_ns=0, seq=seq, up=up, rate=(0.0, 0.0, 0.0), valid=valid, age_ns=0)


@pytest.mark.parametrize(
    ("valid", "late_ms", "heeded"),
    [(True, 0.0, True), (True, 99.0, True), (True, 101.0, False), (False, 0.0, False)],
)
def test_an_attitude_is_heeded_while_it_is_fresh_and_valid(
    robot: RobotConfig, closed: Closed, valid: bool, late_ms: float, heeded: bool
) -> None:
    q = closed(1.188)
    planner = Planner(with_imu(robot, stale_ms=100.0), SESSION)
    receive_all(planner, q, START_NS)
    planner.receive_attitude(attitude(0.0, 1), START_NS)
    planner.tick(START_NS)
    before = planner.status(START_NS, 0.0)
    assert before.attitude_seq == 1
    planner.receive_attitude(attitude(0.05, 2, valid=valid), START_NS + 1)
    later = START_NS + 1 + round(late_ms * NS_PER_MS)
    receive_all(planner, q, later, seq=2)
    planner.tick(later)
    after = planner.status(later, 0.0)
    assert after.attitude_seq == 2
    assert (after.slope != before.slope) is heeded
