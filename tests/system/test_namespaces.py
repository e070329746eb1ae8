"""The fleet on three hosts, live: their network is cut and mended, and the robot stands.

Outcomes only, no milliseconds: within one machine all hosts have the same monotonic clock, so
what a module did during a cut is told by the stamps of its states, however late they come.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

from shared.bus import topics
from shared.bus.messages import (
    Cause,
    JointCommand,
    JointEvent,
    JointState,
    Mode,
    PlannerMode,
    PlannerStatus,
)
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.places import CHECKOUT
from tests.system.fleets import wait_for
from tests.system.multihost import BODY, LEGS, RECORDED, REPORT, Cut, Report
from tests.system.namespaces import isolation, processes_in
from tests.system.stalls import stalled_before_it_began
from tools.fleet import procfs
from tools.logs.run_log import RunLog, read_run

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(240)]

TRIES = 2
LEADING_S = 80.0
ENDING_S = 20.0


class Ended(NamedTuple):
    """How the process that leads ended."""

    code: int
    said: str


class Led(NamedTuple):
    """A run on three hosts, after its end."""

    report: Report
    log: RunLog
    own: RunLog
    """The record that the left leg's host made of its own services."""
    run_dir: Path
    interfaces_before: list[str]


def interfaces() -> list[str]:
    """Return the network interfaces of this process's own namespace."""
    return sorted(name for _, name in socket.if_nameindex())


@pytest.fixture(scope="module")
def led(tmp_path_factory: pytest.TempPathFactory) -> Led:
    """Lead the fleet through every cut, once for all claims.

    A machine that stalls makes drop-outs of its own, after which the modules wait: a run that
    came too late is made again, but only if the robot stood and nothing went wrong in it.
    """
    before, why = interfaces(), "this machine stalled so often that the scenario could not begin"
    for _ in range(TRIES):
        out = tmp_path_factory.mktemp("multihost")
        with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as parent:
            run_dir = Path(parent) / "run"
            ended = lead_in_a_process(out, run_dir)
        if stalled_before_it_began(ended.code, ended.said, out):
            continue
        assert ended.code == 0, f"it could not be led; logs in {out}\n{ended.said}"
        report = msgspec.json.decode((out / REPORT).read_bytes(), type=Report)
        log = read_run(out)
        truth: list[SimTruth] = log.messages(topics.SIM_TRUTH)
        assert truth, f"nothing of the robot was recorded; logs in {out}\n{ended.said}"
        fell = [row.scenario_s for row in truth if row.fallen]
        assert not fell, f"the robot fell at {fell[0]:.2f} s of {report.cuts}; record in {out}"
        if report.finished_ns:
            return Led(report, log, read_run(out / RECORDED), run_dir, before)
        why = f"not all six track again after the cuts: {report.cuts}; logs in {out}"
    pytest.fail(why)


def lead_in_a_process(out: Path, run_dir: Path) -> Ended:
    """Run `tests.system.multihost` to its end, or skip the test where no namespace can be had."""
    words, refusal = isolation()
    if refusal:
        pytest.skip(refusal)
    program = ("-X", "faulthandler", "-m", "tests.system.multihost")
    # a session of its own: Ctrl-C reaches this process alone, which then ends the other
    leader = subprocess.Popen(
        [*words, sys.executable, *program, str(out), str(run_dir), str(os.getpid())],
        cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True,
    )  # fmt: skip
    try:
        output = leader.communicate(timeout=LEADING_S)[0]
        return Ended(leader.returncode, output)
    finally:
        leader.terminate()
        try:
            leader.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            leader.send_signal(signal.SIGABRT)  # Python's fault handler then tells where it is
            pytest.fail(f"{leader.args} has not ended: {leader.communicate()[0]}")


def spans(led: Led) -> list[tuple[Cut, int]]:
    """Return each cut with the time up to which what happens is its doing."""
    ends = [*(cut.down_ns for cut in led.report.cuts[1:]), led.report.finished_ns]
    return list(zip(led.report.cuts, ends, strict=True))


def states_of(led: Led, module: str) -> list[JointState]:
    return led.log.messages(topics.JOINT_STATE, module)


def reached(cut: Cut) -> tuple[str, ...]:
    """Return the modules that the planner still reaches."""
    return () if cut.host == BODY else tuple(m for m in MODULES if m not in LEGS[cut.host])


def test_the_robot_stands_through_every_cut_and_leads_again(led: Led) -> None:
    truth: list[SimTruth] = led.log.messages(topics.SIM_TRUTH)
    assert not any(row.fallen for row in truth)
    for cut, end_ns in spans(led):
        assert 0 < cut.down_ns < cut.up_ns < end_ns
        for module in MODULES:
            states = states_of(led, module)
            tracking = [s for s in states if s.mode == Mode.TRACK and cut.up_ns < s.t_ns < end_ns]
            assert tracking, f"{module} did not track again after {cut}"


def test_the_modules_of_a_cut_off_leg_hold_by_themselves(led: Led, robot: RobotConfig) -> None:
    patience_ns = round(robot.joint_service.max_command_age_ms * NS_PER_MS)
    seen = 0
    for cut, _ in spans(led):
        for module in set(MODULES) - set(reached(cut)):
            states = states_of(led, module)
            # No echo is younger than the cut, so no command is usable beyond its age limit.
            alone = [s for s in states if cut.down_ns + patience_ns < s.t_ns < cut.up_ns]
            assert {s.mode for s in alone} <= {Mode.HOLD}
            assert {s.cause for s in alone} <= {Cause.COMMAND_STALE, Cause.HOLD_ALL}
            seen += len(alone)
            before = [s.dropouts for s in states if s.t_ns <= cut.down_ns]
            after = [s.dropouts for s in states if s.t_ns > cut.up_ns]
            assert max(after) > before[-1], f"{module} was never without commands in {cut}"
    assert seen, "no link outlived its cut: nothing tells what the modules did meanwhile"


def test_the_modules_that_are_still_reached_hold(led: Led) -> None:
    causes = set()
    for cut, _ in spans(led):
        for module in reached(cut):
            commands: list[JointCommand] = led.log.messages(topics.JOINT_COMMAND, module)
            assert any(c.hold for c in commands if cut.down_ns < c.t_ns < cut.up_ns)
            events: list[JointEvent] = led.log.messages(topics.JOINT_EVENT, module)
            into_hold = [
                event
                for event in events
                if cut.down_ns < event.t_ns < cut.up_ns and event.mode_after == Mode.HOLD
            ]
            assert into_hold, f"{module} worked against the leg that was cut off in {cut}"
            causes |= {event.cause for event in into_hold}
    assert Cause.HOLD_ALL in causes


def test_the_planner_leads_only_while_it_receives_all_six(led: Led) -> None:
    statuses: list[PlannerStatus] = led.log.messages(topics.PLANNER_STATUS)
    for cut, end_ns in spans(led):
        modes = [s.mode for s in statuses if cut.down_ns < s.t_ns < end_ns]
        assert PlannerMode.WAITING in modes
        assert modes[-1] == PlannerMode.LEADING


def test_a_cut_silences_no_process_on_the_hosts_that_are_not_cut_off(led: Led) -> None:
    for topic in (topics.PLANNER_STATUS, topics.SIM_TRUTH):
        key = topic.key(led.log.robot)
        assert led.log.gaps()[key].missing == 0, f"{key} was not heard on its own host"


def test_nothing_passes_a_cut_until_it_is_mended(led: Led) -> None:
    late = 0
    for cut, _ in spans(led):
        for module in set(MODULES) - set(reached(cut)):
            states = states_of(led, module)
            received_ns = led.log.received_ns(topics.JOINT_STATE, module)
            meanwhile = [
                received
                for state, received in zip(states, received_ns, strict=True)
                if cut.down_ns < state.t_ns < cut.up_ns
            ]
            assert all(received > cut.up_ns for received in meanwhile)
            late += len(meanwhile)
    assert late, "no link outlived its cut and brought what was said meanwhile"


def test_the_cut_off_legs_own_record_has_every_state_that_reached_nobody(led: Led) -> None:
    for module in LEGS[RECORDED]:
        states = [
            [s.seq for s in log.messages(topics.JOINT_STATE, module)] for log in (led.log, led.own)
        ]
        assert len(states[0]) < len(states[1]), "the cut kept some from the fleet's recorder"
        assert states[1] == list(range(states[1][0], states[1][0] + len(states[1])))


def test_a_run_on_three_hosts_leaves_no_process_and_no_network(led: Led) -> None:
    assert len(set(led.report.namespaces)) == len(LEGS) + 2
    assert wait_for(lambda: not processes_in(led.report.namespaces), ENDING_S)
    assert procfs.fleet_pids(led.run_dir) == set()
    assert interfaces() == led.interfaces_before
