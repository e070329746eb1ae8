"""What the doctor says of the CAN buses, by what came on them."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from shared.can.cansimple import AxisState, Heartbeat
from shared.can.cansimple_06 import Version
from shared.can.sensor_frames import ImuSample
from shared.config.robot_config import RobotConfig
from shared.config.sections import CanConfig
from tests.imu.robots import with_imu
from tests.tools.bringup.verdicts import OK, WRONG, bad
from tools.bringup import check_can
from tools.bringup.can_monitor import (
    BusTraffic,
    NodeTraffic,
    SensorTraffic,
    bus_nodes,
    long_enough,
    period_ms,
)
from tools.bringup.findings import Finding

MODULE = "knee_left"
NODES = (8, 9)
AXIS0, AXIS1 = f"{MODULE}.axis0", f"{MODULE}.axis1"
IDLE = Heartbeat(0, AxisState.IDLE, False, False, False, True)
FAILED = IDLE._replace(motor_failed=True)


def times(period_s: float, n: int = 40) -> list[float]:
    return [period_s * i for i in range(n)]


def axis(heartbeat: Heartbeat = IDLE, encoder_s: float = 0.002) -> NodeTraffic:
    return NodeTraffic(heartbeat, times(0.02, 10), times(encoder_s), pos_turns=64.0)


def healthy(**changes: NodeTraffic) -> BusTraffic:
    nodes = {8: axis(), 9: axis()} | {int(name[4:]): node for name, node in changes.items()}
    return BusTraffic(seconds=0.5, frames=600, nodes=nodes)


def twice(apart_s: float) -> NodeTraffic:
    both = sorted(t + late for t in times(0.02, 25) for late in (0.0, apart_s))
    # the first and the last gap are long ones: so is then the median of 1 and 19 ms
    return NodeTraffic(IDLE, both[1:-1], times(0.002), pos_turns=64.0)


def rows_of(robot: RobotConfig, traffic: BusTraffic) -> list[Finding]:
    return check_can.drive_rows(robot, MODULE, traffic, services_up=False)


NEW = axis(FAILED)
NEW.version = Version(2, (4, 4, 58), (0, 6, 10), 0)
MUTE = axis()
MUTE.estimates_s = []


STRANGERS = BusTraffic(nodes={8: NodeTraffic(), 9: NodeTraffic(), 0: axis(), 1: axis()})
CASES: dict[str, tuple[BusTraffic, list[str], tuple[str, ...]]] = {
    "both axes at their periods": (healthy(), [], ()),
    "an encoder at its factory period": (
        healthy(node8=axis(encoder_s=0.01)), [f"{AXIS0}: encoder frames: warning"],
        ("10.0 ms", "2 ms", "encoder_rate_ms"),
    ),
    "no encoder frames": (healthy(node9=MUTE), [f"{AXIS1}: encoder frames: wrong"], ()),
    "no heartbeat": (healthy(node9=NodeTraffic()), [f"{AXIS1}: heartbeat: wrong"], ()),
    "others on a silent bus": (
        STRANGERS, [f"{MODULE}: heartbeats: wrong"], ("nodes 0, 1 are heard",)
    ),
    "a failed motor though the axis error is 0": (
        healthy(node8=axis(FAILED)), [f"{AXIS0}: errors: wrong"], ("MOTOR_FAILED",)
    ),
    "firmware 0.6, whose heartbeats are not taken for errors": (
        healthy(node8=NEW), [f"{AXIS0}: firmware: warning"], ()
    ),
    **{
        f"two axes under one node id, {apart_s} s apart": (
            healthy(node8=twice(apart_s)), [f"{AXIS0}: heartbeat: warning"], ("the same node id",)
        )
        for apart_s in (0.001, 0.005, 0.010)
    },
}  # fmt: skip


@pytest.mark.parametrize(("traffic", "expected", "words"), CASES.values(), ids=CASES.keys())
def test_what_is_not_right_with_a_modules_axes_is_named(
    robot: RobotConfig, traffic: BusTraffic, expected: list[str], words: tuple[str, ...]
) -> None:
    rows = rows_of(robot, traffic)
    assert bad(rows) == expected
    assert expected or len(rows) == 8
    told = " ".join(str(row) for row in rows if row.verdict is not OK)
    assert all(word in told for word in words)


@pytest.mark.parametrize(
    ("answered", "turns"),
    [({}, None), ({"shadow_count": 64 * 16384}, 64.0), ({"version": NEW.version}, 0.0)],
    ids=["nothing", "a count", "firmware 0.6"],
)
def test_an_estimate_of_0_is_believed_of_new_firmware_only(
    robot: RobotConfig, answered: dict[str, Any], turns: float | None
) -> None:
    """On a full machine the count's answer came too late, and a zero was called lost."""
    traffic = healthy(axis9=NodeTraffic(IDLE, pos_turns=0.0, **answered))
    found = check_can.positions(robot, MODULE, traffic)
    assert found == (None if turns is None else (64.0, turns))


NO_CAN = f"[Errno {errno.EAFNOSUPPORT}] {os.strerror(errno.EAFNOSUPPORT)}"


@pytest.mark.parametrize(
    ("interface", "trouble", "words"),
    [
        ("xrl_unix", "no such device", "simulator"),
        ("socketcan", "no such device", "ip link set can7 up"),
        pytest.param("socketcan", NO_CAN, "modprobe can_raw", id="a kernel without CAN"),
    ],
)
def test_a_bus_that_cannot_be_opened_names_how_to_open_it(
    robot: RobotConfig, interface: str, trouble: str, words: str
) -> None:
    can = {name: CanConfig(interface=interface, channel="can7") for name in robot.can}
    (row,) = rows_of(msgspec.structs.replace(robot, can=can), BusTraffic(trouble=trouble))
    assert row.verdict is WRONG
    assert words in row.fix


def cells(rate_hz: float = 250.0, force: float = 20.0, malformed: int = 0) -> BusTraffic:
    sample = (force, 0.0, 0.0, 0.0, 0.0, -force)
    heard = SensorTraffic([sample] * 50, times(1.0 / rate_hz, 50))
    return BusTraffic(seconds=50 / rate_hz, cells=heard, malformed=malformed)


def imu(*, valid: bool = True, period_s: float = 0.01) -> BusTraffic:
    sample = ImuSample((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), valid)
    return BusTraffic(frames=150, imu=SensorTraffic([sample] * 50, times(period_s, 50)))


HARNESS, IMU = check_can.harness_rows, check_can.imu_rows


@pytest.mark.parametrize(
    ("judge", "traffic", "expected"),
    [
        (HARNESS, cells(), []),
        (HARNESS, cells(rate_hz=100.0), ["harness: load cells: warning"]),
        (HARNESS, cells(force=1500.0), ["harness: largest force: wrong"]),
        (HARNESS, cells(force=math.nan), ["harness: largest force: wrong"]),
        (HARNESS, cells(malformed=3), ["harness: frames out of order: warning"]),
        (HARNESS, BusTraffic(seconds=0.5, frames=3), ["harness: load cells: wrong"]),
        (HARNESS, BusTraffic(trouble="gone"), ["harness: CAN bus: wrong"]),
        (IMU, imu(), []),
        (IMU, imu(period_s=0.02), ["IMU: samples: warning"]),
        (IMU, imu(valid=False), ["IMU: orientation valid: wrong"]),
        (IMU, BusTraffic(frames=7), ["IMU: samples: wrong"]),
        (IMU, BusTraffic(trouble="no such device"), ["IMU: CAN bus: wrong"]),
    ],
)
def test_a_sensor_is_judged_by_its_rate_its_range_and_its_own_flags(
    robot: RobotConfig,
    judge: Callable[[RobotConfig, BusTraffic], list[Finding]],
    traffic: BusTraffic,
    expected: list[str],
) -> None:
    rows = judge(robot, traffic)
    assert bad(rows) == expected
    assert not traffic.malformed or rows[-1].found == "3"


def test_the_period_stands_a_reader_that_stalls_and_a_sender_that_catches_up() -> None:
    stalled = [0.002 * i + (0.3 if i > 20 else 0.0) for i in range(40)]
    assert period_ms(stalled, 2.0) == pytest.approx(2.0)
    bursts = [0.002 * i if i % 2 else 0.002 * (i - 1) + 0.0001 for i in range(40)]
    assert period_ms(bursts, 2.0) == pytest.approx(2.0, rel=0.1)
    assert period_ms(times(0.01), 2.0) == pytest.approx(10.0), "another period is what it is"
    assert period_ms(times(0.002, 3), 2.0) is None


@pytest.mark.parametrize(("period", "seconds"), [(20, 0.5), (500, 1.5), (10_000, 3.0)])
def test_it_listens_for_some_heartbeats_but_not_for_ever(period: int, seconds: float) -> None:
    assert long_enough(period) == pytest.approx(seconds)


def test_every_bus_of_the_robot_is_listened_to_an_imus_where_one_is_fitted(
    robot: RobotConfig,
) -> None:
    nodes = bus_nodes(robot)
    assert sorted(nodes) == sorted(robot.buses)
    assert nodes[MODULE] == NODES
    assert nodes[robot.harness.bus] == ()
    assert "imu" not in nodes
    assert bus_nodes(with_imu(robot))["imu"] == ()
