"""What the doctor says of the CAN buses, by what came on them."""

from __future__ import annotations

import errno
import os

import msgspec
import pytest

from shared.can.cansimple import AxisState, Heartbeat
from shared.can.cansimple_06 import Version
from shared.can.imu_can import ImuSample
from shared.config.robot_config import RobotConfig
from shared.config.sections import CanConfig
from tests.imu.robots import with_imu
from tools.bringup import check_can
from tools.bringup.can_monitor import (
    BusTraffic,
    NodeTraffic,
    SensorTraffic,
    long_enough,
    period_ms,
)
from tools.bringup.findings import Finding, FindingKind

MODULE = "knee_left"
NODES = (8, 9)
IDLE = Heartbeat(0, AxisState.IDLE, False, False, False, True)


def times(period_s: float, n: int = 40) -> list[float]:
    return [period_s * i for i in range(n)]


def axis(
    heartbeat: Heartbeat = IDLE, heartbeat_s: float = 0.02, encoder_s: float = 0.002
) -> NodeTraffic:
    return NodeTraffic(heartbeat, times(heartbeat_s, 10), times(encoder_s), pos_turns=64.0)


def healthy() -> BusTraffic:
    return BusTraffic(seconds=0.5, frames=600, nodes={node: axis() for node in NODES})


def rows_of(robot: RobotConfig, traffic: BusTraffic) -> list[Finding]:
    return check_can.drive_rows(robot, MODULE, traffic, services_up=False)


def bad(rows: list[Finding]) -> list[tuple[str, str, FindingKind]]:
    return [(row.subject, row.what, row.verdict) for row in rows if row.verdict != FindingKind.OK]


def test_a_bus_that_carries_both_axes_at_their_periods_is_ok(robot: RobotConfig) -> None:
    rows = rows_of(robot, healthy())
    assert bad(rows) == []
    assert len(rows) == 8


def test_an_encoder_at_its_factory_period_is_a_warning_with_the_setting(robot: RobotConfig) -> None:
    traffic = healthy()
    traffic.nodes[8] = axis(encoder_s=0.01)
    rows = rows_of(robot, traffic)
    assert bad(rows) == [(f"{MODULE}.axis0", "encoder frames", FindingKind.WARNING)]
    row = next(row for row in rows if row.verdict != FindingKind.OK)
    assert (row.found, row.wanted) == ("10.0 ms", "2 ms")
    assert "encoder_rate_ms" in row.fix


def test_an_axis_without_encoder_frames_is_wrong(robot: RobotConfig) -> None:
    traffic = healthy()
    traffic.nodes[9].estimates_s = []
    assert bad(rows_of(robot, traffic)) == [
        (f"{MODULE}.axis1", "encoder frames", FindingKind.WRONG)
    ]


def test_an_axis_that_sends_no_heartbeat_is_wrong(robot: RobotConfig) -> None:
    traffic = healthy()
    traffic.nodes[9] = NodeTraffic()
    assert bad(rows_of(robot, traffic)) == [(f"{MODULE}.axis1", "heartbeat", FindingKind.WRONG)]


def test_other_nodes_on_a_silent_bus_are_named(robot: RobotConfig) -> None:
    traffic = BusTraffic(nodes={8: NodeTraffic(), 9: NodeTraffic(), 0: axis(), 1: axis()})
    (row,) = rows_of(robot, traffic)
    assert row.verdict is FindingKind.WRONG
    assert "nodes 0, 1 are heard" in row.fix


def test_a_failed_motor_shows_though_the_axis_error_is_0(robot: RobotConfig) -> None:
    traffic = healthy()
    traffic.nodes[8] = axis(IDLE._replace(motor_failed=True))
    rows = rows_of(robot, traffic)
    assert bad(rows) == [(f"{MODULE}.axis0", "errors", FindingKind.WRONG)]
    assert "MOTOR_FAILED" in next(row.found for row in rows if row.verdict != FindingKind.OK)


def test_firmware_0_6_is_named_and_its_heartbeats_are_not_taken_for_errors(
    robot: RobotConfig,
) -> None:
    traffic = healthy()
    traffic.nodes[8] = axis(IDLE._replace(motor_failed=True))
    traffic.nodes[8].version = Version(2, (4, 4, 58), (0, 6, 10), 0)
    rows = rows_of(robot, traffic)
    assert bad(rows) == [(f"{MODULE}.axis0", "firmware", FindingKind.WARNING)]


@pytest.mark.parametrize(
    ("interface", "words"), [("xrl_unix", "simulator"), ("socketcan", "ip link set can7 up")]
)
def test_a_bus_that_cannot_be_opened_names_how_to_open_it(
    robot: RobotConfig, interface: str, words: str
) -> None:
    can = {name: CanConfig(interface=interface, channel="can7") for name in robot.can}
    other = msgspec.structs.replace(robot, can=can)
    (row,) = rows_of(other, BusTraffic(trouble="no such device"))
    assert row.verdict is FindingKind.WRONG
    assert words in row.fix


def test_a_kernel_without_can_gets_no_advice_to_bring_an_interface_up(robot: RobotConfig) -> None:
    can = {name: CanConfig(interface="socketcan", channel="can7") for name in robot.can}
    other = msgspec.structs.replace(robot, can=can)
    trouble = f"[Errno {errno.EAFNOSUPPORT}] {os.strerror(errno.EAFNOSUPPORT)}"
    (row,) = rows_of(other, BusTraffic(trouble=trouble))
    assert "modprobe can_raw" in row.fix


@pytest.mark.parametrize("apart_s", [0.001, 0.005, 0.010])
def test_two_axes_under_one_node_id_show_however_their_heartbeats_fall(
    robot: RobotConfig, apart_s: float
) -> None:
    traffic = healthy()
    both = sorted(t + late for t in times(0.02, 25) for late in (0.0, apart_s))
    # the first and the last gap are long ones: so is then the median of 1 and 19 ms
    traffic.nodes[8] = NodeTraffic(IDLE, both[1:-1], times(0.002), pos_turns=64.0)
    rows = rows_of(robot, traffic)
    assert bad(rows) == [(f"{MODULE}.axis0", "heartbeat", FindingKind.WARNING)]
    assert "the same node id" in next(row.why for row in rows if row.verdict != FindingKind.OK)


def cells(rate_hz: float = 250.0, force: float = 20.0) -> BusTraffic:
    n = 50
    sample = (force, 0.0, 0.0, 0.0, 0.0, -force)
    heard = SensorTraffic([sample] * n, times(1.0 / rate_hz, n))
    return BusTraffic(seconds=n / rate_hz, cells=heard)


@pytest.mark.parametrize(
    ("traffic", "expected"),
    [
        (cells(), []),
        (cells(rate_hz=100.0), [("load cells", FindingKind.WARNING)]),
        (cells(force=1500.0), [("largest force", FindingKind.WRONG)]),
        (cells(force=float("nan")), [("largest force", FindingKind.WRONG)]),
        (BusTraffic(seconds=0.5, frames=3), [("load cells", FindingKind.WRONG)]),
        (BusTraffic(trouble="gone"), [("CAN bus", FindingKind.WRONG)]),
    ],
)
def test_the_load_cells_are_judged_by_rate_and_range(
    robot: RobotConfig, traffic: BusTraffic, expected: list[tuple[str, FindingKind]]
) -> None:
    rows = check_can.harness_rows(robot, traffic)
    assert [(row.what, row.verdict) for row in rows if row.verdict != FindingKind.OK] == expected


def test_frames_of_load_cells_out_of_order_are_counted(robot: RobotConfig) -> None:
    traffic = cells()
    traffic.malformed = 3
    assert [row.found for row in check_can.harness_rows(robot, traffic)][-1] == "3"


def test_the_period_stands_a_reader_that_stalls_and_a_sender_that_catches_up() -> None:
    stalled = [0.002 * i + (0.3 if i > 20 else 0.0) for i in range(40)]
    assert period_ms(stalled, 2.0) == pytest.approx(2.0)
    bursts = [0.002 * i if i % 2 else 0.002 * (i - 1) + 0.0001 for i in range(40)]
    assert period_ms(bursts, 2.0) == pytest.approx(2.0, rel=0.1)


def test_another_period_is_seen_as_what_it_is() -> None:
    assert period_ms(times(0.01), 2.0) == pytest.approx(10.0)
    assert period_ms(times(0.002, 3), 2.0) is None


@pytest.mark.parametrize(("period", "seconds"), [(20, 0.5), (500, 1.5), (10_000, 3.0)])
def test_it_listens_for_some_heartbeats_but_not_for_ever(period: int, seconds: float) -> None:
    assert long_enough(period) == pytest.approx(seconds)


def test_every_bus_of_the_robot_is_listened_to(robot: RobotConfig) -> None:
    nodes = check_can.bus_nodes(robot)
    assert sorted(nodes) == sorted(robot.buses)
    assert nodes[MODULE] == NODES
    assert nodes[robot.harness.bus] == ()


def imu_heard(*, valid: bool = True, period_s: float = 0.01) -> BusTraffic:
    sample = ImuSample((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), valid)
    return BusTraffic(frames=150, imu=SensorTraffic([sample] * 50, times(period_s, 50)))


@pytest.mark.parametrize(
    ("traffic", "wrong"),
    [
        (imu_heard(), []),
        (imu_heard(period_s=0.02), [("IMU", "samples", FindingKind.WARNING)]),
        (imu_heard(valid=False), [("IMU", "orientation valid", FindingKind.WRONG)]),
        (BusTraffic(frames=7), [("IMU", "samples", FindingKind.WRONG)]),
        (BusTraffic(trouble="no such device"), [("IMU", "CAN bus", FindingKind.WRONG)]),
    ],
)
def test_an_imu_is_judged_by_its_rate_and_its_own_flags(
    robot: RobotConfig, traffic: BusTraffic, wrong: list[tuple[str, str, FindingKind]]
) -> None:
    assert bad(check_can.imu_rows(robot, traffic)) == wrong


def test_a_bus_is_listened_to_for_an_imu_only_where_one_is_fitted(robot: RobotConfig) -> None:
    assert "imu" not in check_can.bus_nodes(robot)
    assert check_can.bus_nodes(with_imu(robot))["imu"] == ()
