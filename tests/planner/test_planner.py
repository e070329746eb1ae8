"""One planner tick without any I/O: who is heard, what is echoed, when it is time."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from services.planner.intents import OperatorRequest
from services.planner.law.certificate import Margins
from services.planner.planner import EARLY_FRACTION, LATE_FRACTION, TICK_GAP_MAX_S, Planner
from services.planner.watch.engagement_fsm import WAITS_NS
from shared.bus.messages import (
    DriveStatus,
    JointCommand,
    JointState,
    Mode,
    PlannerMode,
    SplitSource,
    Tare,
    Wrench,
)
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config import gain_schedule
from shared.config.robot_config import RobotConfig
from shared.joints import N_MODULES
from tests.planner.conftest import Closed, standing_torque
from tests.planner.oracle import Array

SESSION = 4711
START_NS = 10**12


@pytest.fixture
def planner(robot: RobotConfig) -> Planner:
    return Planner(robot, SESSION)


@pytest.fixture
def q(closed: Closed) -> Array:
    return closed(1.188, x=0.01, pitch=0.1)


def state(module: int, q: Array, seq: int = 1, **changes: object) -> JointState:
    """Return the state of a module of a robot that stands on its feet."""
    tau = standing_torque(tuple(q.tolist())) if np.isfinite(q).all() else np.zeros(12)
    fields: dict[str, object] = {
        "t_ns": 1000 * (module + 1) + seq,
        "seq": seq,
        "q": (float(q[2 * module]), float(q[2 * module + 1])),
        "v": (0.0, 0.0),
        "tau": (float(tau[2 * module]), float(tau[2 * module + 1])),
        "mode": int(Mode.TRACK),
        "cause": 0,
        "ready": True,
        "age_ns": 4_000_000,
        "session": SESSION,
        "command_seq": -1,
        "cycle": 0,
        "late": 0,
        "dropouts": 0,
        "refused": 0,
        "drive": DriveStatus.ARMED,
        "drive_error": 0,
    }
    return JointState(**(fields | changes))  # type: ignore[arg-type]


def receive_all(planner: Planner, q: Array, now_ns: int, seq: int = 1, **changes: object) -> None:
    for module in range(N_MODULES):
        planner.receive_state(module, state(module, q, seq, **changes), now_ns)


def lead(planner: Planner, q: Array, now_ns: int = START_NS) -> int:
    """Bring the planner to lead; return the time of its last tick."""
    for tick in range(3):
        now_ns += 4 * NS_PER_MS
        receive_all(planner, q, now_ns, seq=tick)
        planner.tick(now_ns)
    assert planner.status(now_ns, 0.0).mode == PlannerMode.LEADING
    return now_ns


def joined(commands: list[JointCommand], name: str) -> Array:
    return np.concatenate([getattr(command, name) for command in commands])


def test_no_commands_before_the_states_of_all_six(planner: Planner, q: Array) -> None:
    for module in range(N_MODULES - 1):
        planner.receive_state(module, state(module, q), START_NS)
        assert planner.tick(START_NS + module) == []
    status = planner.status(START_NS + 10, 1.0)
    assert status.mode == PlannerMode.WAITING
    assert status.hold
    assert status.state_seq == (1, 1, 1, 1, 1, -1)
    assert status.state_age_ns == (10, 10, 10, 10, 10, -1)
    planner.receive_state(5, state(5, q), START_NS + 20)
    assert len(planner.tick(START_NS + 20)) == N_MODULES


def test_each_command_echoes_its_own_modules_stamp(planner: Planner, q: Array) -> None:
    receive_all(planner, q, START_NS)
    stamps = [command.echo_t_ns for command in planner.tick(START_NS)]
    assert stamps == [1000 * (module + 1) + 1 for module in range(N_MODULES)]
    planner.receive_state(3, state(3, q, seq=7), START_NS + 1)
    stamps = [command.echo_t_ns for command in planner.tick(START_NS + 4 * NS_PER_MS)]
    assert stamps == [1001, 2001, 3001, 4007, 5001, 6001]


def test_commands_count_up_and_name_the_session(planner: Planner, q: Array) -> None:
    seen = []
    for tick in range(5):
        now = START_NS + tick * 4 * NS_PER_MS
        receive_all(planner, q, now, seq=tick)
        commands = planner.tick(now)
        assert {command.session for command in commands} == {SESSION}
        assert {command.t_ns for command in commands} == {now}
        assert len({command.seq for command in commands}) == 1
        seen.append(commands[0].seq)
        assert planner.status(now, 0.0).seq == commands[0].seq
    assert seen == [1, 2, 3, 4, 5]


def test_all_hold_until_all_are_ready(planner: Planner, q: Array) -> None:
    for tick in range(5):
        now = START_NS + tick * 4 * NS_PER_MS
        receive_all(planner, q, now, seq=tick)
        planner.receive_state(2, state(2, q, seq=tick, ready=False), now)
        assert all(command.hold for command in planner.tick(now))
    receive_all(planner, q, now, seq=9)
    assert not any(command.hold for command in planner.tick(now + 4 * NS_PER_MS))


@pytest.mark.parametrize("silent", range(N_MODULES))
def test_all_hold_while_one_is_stale(
    robot: RobotConfig, planner: Planner, q: Array, silent: int
) -> None:
    start = lead(planner, q)
    stale_ns = round(robot.planner.state_stale_ms * NS_PER_MS)
    for now in (start + stale_ns, start + stale_ns + 1):
        for module in set(range(N_MODULES)) - {silent}:
            planner.receive_state(module, state(module, q, seq=50), now)
        holds = {command.hold for command in planner.tick(now)}
        assert holds == {now > start + stale_ns}
    assert planner.status(now, 0.0).mode == PlannerMode.WAITING


def test_commands_carry_each_modules_part_of_the_law(planner: Planner, q: Array) -> None:
    receive_all(planner, q, START_NS)
    commands = planner.tick(START_NS)
    np.testing.assert_allclose(joined(commands, "q_ref"), q, atol=1e-5)
    np.testing.assert_allclose(joined(commands, "v_ref"), 0.0, atol=1e-6)
    np.testing.assert_allclose(joined(commands, "tau_coupled"), 0.0, atol=0.02)
    assert np.abs(joined(commands, "tau_ff")).max() > 10.0
    assert joined(commands, "k_p").min() > 0.0
    assert joined(commands, "k_d").min() > 0.0


def test_leading_again_starts_from_the_measured_height_and_pitch_and_from_the_middle(
    planner: Planner, q: Array, closed: Closed
) -> None:
    now = lead(planner, q) + NS_PER_S
    elsewhere = closed(1.0, x=-0.03, y=0.02, roll=0.04, pitch=0.4)
    receive_all(planner, elsewhere, now, seq=90)
    planner.tick(now)
    receive_all(planner, elsewhere, now, seq=91, ready=False, mode=int(Mode.HOLD))
    planner.tick(now + 200 * NS_PER_MS)
    receive_all(planner, elsewhere, now + 201 * NS_PER_MS, seq=92, ready=False, mode=int(Mode.HOLD))
    commands = planner.tick(now + 201 * NS_PER_MS)
    assert all(command.hold for command in commands)
    status = planner.status(now + 201 * NS_PER_MS, 0.0)
    np.testing.assert_allclose(
        status.p_ref, np.array(status.p) * (0.0, 0.0, 1.0, 0.0, 1.0, 0.0), atol=1e-9
    )


def test_six_new_states_are_due_after_half_a_period(
    robot: RobotConfig, planner: Planner, q: Array
) -> None:
    last = lead(planner, q)
    half = round(EARLY_FRACTION * NS_PER_S / robot.planner.rate_hz)
    receive_all(planner, q, last + 1, seq=50)
    assert not planner.is_due(last + half - 1)
    assert planner.is_due(last + half)


@pytest.mark.parametrize("heard", [0, 5])
def test_fewer_than_six_are_due_after_a_period_and_a_quarter(
    robot: RobotConfig, planner: Planner, q: Array, heard: int
) -> None:
    last = lead(planner, q)
    late = round(LATE_FRACTION * NS_PER_S / robot.planner.rate_hz)
    for module in range(heard):
        planner.receive_state(module, state(module, q, seq=50), last + 1)
        planner.receive_state(module, state(module, q, seq=51), last + 2)
    assert not planner.is_due(last + late - 1)
    assert planner.is_due(last + late)


def test_a_tick_uses_states_up(planner: Planner, q: Array) -> None:
    last = lead(planner, q)
    receive_all(planner, q, last + 1, seq=50)
    planner.tick(last + 3 * NS_PER_MS)
    assert not planner.is_due(last + 6 * NS_PER_MS)  # 3 ms later, none new


def test_a_long_gap_is_not_integrated(robot: RobotConfig, planner: Planner, q: Array) -> None:
    """A planner stopped for 5 s raises the assist by one bounded step only."""
    last = lead(planner, q)
    planner.receive_request(OperatorRequest(200.0))
    now = last + 5 * NS_PER_S
    receive_all(planner, q, now, seq=50)
    planner.tick(now)
    assist = planner.status(now, 0.0).assist_n
    assert 0.0 < assist <= robot.assist.rate_max * TICK_GAP_MAX_S + 1e-9


def test_assist_rises_by_the_time_between_ticks(
    robot: RobotConfig, planner: Planner, q: Array
) -> None:
    last = lead(planner, q)
    planner.receive_request(OperatorRequest(200.0))
    for tick in range(1, 11):
        now = last + tick * 4 * NS_PER_MS
        receive_all(planner, q, now, seq=50 + tick)
        planner.tick(now)
    assert planner.status(now, 0.0).assist_n == pytest.approx(robot.assist.rate_max * 0.04)


def test_a_status_holds_what_the_tick_saw(planner: Planner, q: Array) -> None:
    receive_all(planner, q, START_NS, seq=7)
    planner.receive_wrench(
        Wrench(
            t_ns=1,
            seq=33,
            force=(0.0, 0.0, 0.0),
            moment=(0.0, 0.0, 0.0),
            valid=True,
            saturated=False,
            tare=Tare.DONE,
            age_ns=0,
        ),
        START_NS + 1,
    )
    planner.tick(START_NS + 2)
    status = planner.status(START_NS + 2, 123.0)
    assert status.t_ns == START_NS + 2
    assert status.session == SESSION
    assert status.mode == PlannerMode.ALIGNING
    assert status.hold
    assert status.state_seq == (7,) * 6
    assert status.state_age_ns == (2,) * 6
    assert status.wrench_seq == 33
    assert status.tick_us == 123.0
    assert status.p[0] == pytest.approx(0.01, abs=1e-6)
    assert status.p[4] == pytest.approx(0.1, abs=1e-6)
    assert status.p_ref == pytest.approx(status.p, abs=1e-9)
    assert status.closure == pytest.approx((0.0,) * 6, abs=1e-6)
    assert status.pdot == (0.0,) * 6
    assert status.ik_residual < 1e-6


def test_commands_and_status_hold_both_margins_and_where_the_gains_come_from(
    robot: RobotConfig, planner: Planner, q: Array
) -> None:
    now = lead(planner, q)
    receive_all(planner, q, now, seq=50)
    commands = planner.tick(now + 4 * NS_PER_MS)
    status = planner.status(now + 4 * NS_PER_MS, 0.0)
    assert {command.margin for command in commands} == {status.margin}
    assert {command.margin_onboard for command in commands} == {status.margin_onboard}
    assert status.split == SplitSource.SCHEDULE
    assert status.margin >= robot.certificate.margin_min
    assert status.margin_onboard >= robot.certificate.onboard_margin_min


def test_gains_that_would_not_stand_ask_for_hold_in_that_very_tick(
    robot: RobotConfig, planner: Planner, q: Array
) -> None:
    """The mode follows a tick later; when the gains stand again it waits as after a drop-out."""
    now = lead(planner, q)
    split = planner._law._split
    least = split._margins_min
    seen = []
    wait_ns = WAITS_NS[1]
    for tick, (fails, after_ns) in enumerate(
        ((False, 0), (True, 0), (True, 0), (False, 0), (False, 0), (False, wait_ns), (False, 0))
    ):
        split._margins_min = Margins(1e9, 1e9) if fails else least
        now += 4 * NS_PER_MS + after_ns
        receive_all(planner, q, now, seq=50 + tick)
        commands = planner.tick(now)
        status = planner.status(now, 0.0)
        assert (status.split == SplitSource.UNCERTIFIED) == fails
        seen.append((PlannerMode(status.mode), {command.hold for command in commands}))
    assert seen == [
        (PlannerMode.LEADING, {False}),
        (PlannerMode.LEADING, {True}),
        (PlannerMode.UNCERTIFIED, {True}),
        (PlannerMode.UNCERTIFIED, {True}),
        (PlannerMode.ALIGNING, {True}),
        (PlannerMode.LEADING, {False}),
        (PlannerMode.LEADING, {False}),
    ]


def test_a_robot_that_nothing_holds_is_never_lead(robot: RobotConfig, q: Array) -> None:
    certificate = msgspec.structs.replace(robot.certificate, K_required=(1e5,) * 6)
    stiff = msgspec.structs.replace(robot, certificate=certificate)
    inputs = gain_schedule.inputs_of(stiff)
    assert robot.gain_schedule is not None
    fitting = msgspec.structs.replace(
        robot.gain_schedule, inputs=inputs, digest=gain_schedule.digest_of(inputs)
    )
    planner = Planner(msgspec.structs.replace(stiff, gain_schedule=fitting), SESSION)
    for tick in range(10):
        now = START_NS + tick * 4 * NS_PER_MS
        receive_all(planner, q, now, seq=tick)
        assert all(command.hold for command in planner.tick(now))
    status = planner.status(now, 0.0)
    assert status.mode == PlannerMode.UNCERTIFIED
    assert status.hold
    assert status.margin < robot.certificate.margin_min


def test_a_stale_state_counts_before_uncertified_gains(
    robot: RobotConfig, planner: Planner, q: Array
) -> None:
    now = lead(planner, q)
    planner._law._split._margins_min = Margins(1e9, 1e9)
    for silence_ms in (4, 200):
        now += silence_ms * NS_PER_MS
        planner.tick(now)
    assert planner.status(now, 0.0).mode == PlannerMode.WAITING


def test_a_status_before_any_state_is_finite(planner: Planner) -> None:
    status = planner.status(START_NS, 0.0)
    assert status.mode == PlannerMode.WAITING
    assert status.hold
    assert status.wrench_seq == -1
    assert status.state_seq == status.state_age_ns == (-1,) * 6
    assert np.isfinite([*status.p, *status.p_ref, *status.closure]).all()
