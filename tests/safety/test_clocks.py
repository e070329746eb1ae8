"""Stamps that cannot be, sessions that are over, commands that come again: refused and counted.

An age is measured on one clock, the host's monotonic (docs/architecture.md#age-rule): a
clock that cannot step. Runs with clocks of several hosts: `tests/lockstep/test_clocks.py`.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import NamedTuple

import pytest

from services.joint.failsafe import timing_of
from shared.bus.messages import Mode
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import SESSION, Bench

ROOT = Path(__file__).resolve().parents[2]
HOUR_NS = 3600 * NS_PER_S
WILD = {"q_ref": (0.3, -2.5), "k_p": (3000.0, 3000.0), "tau_ff": (50.0, -50.0)}
"""Within every limit: taken, it would throw the module."""


def test_no_service_that_controls_reads_the_time_of_day() -> None:
    """So that whatever steps it (NTP, a person, a battery that is empty) changes nothing."""
    of_day = {"time", "time_ns", "now", "utcnow", "today", "gettimeofday", "CLOCK_REALTIME"}
    paths = [
        p
        for room in ("joint", "planner", "harness")
        for p in (ROOT / "services" / room).rglob("*.py")
    ]
    paths += [ROOT / "shared" / name for name in ("clock.py", "bus/session.py", "bus/codec.py")]
    assert len(paths) > 40
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                owner = node.value.id
                assert not (owner in ("time", "datetime", "date") and node.attr in of_day), path
            if isinstance(node, ast.ImportFrom) and node.module in ("time", "datetime"):
                assert not {alias.name for alias in node.names} & (of_day | {"datetime"}), path


class Forgery(NamedTuple):
    """What is wrong with a command: the age of its echo, its session, and what it counts."""

    age_ns: int = 0
    session: int = SESSION
    newer: bool = True


RETIRED = SESSION - 1
FUTURE = [1, NS_PER_MS, NS_PER_S, HOUR_NS, 24 * HOUR_NS, 1 << 61]
PAST = [50 * NS_PER_MS + 1, 51 * NS_PER_MS, NS_PER_S, HOUR_NS, 24 * HOUR_NS, 1 << 61]
FORGERIES = {
    **{f"{ns} ns ahead": Forgery(age_ns=-ns) for ns in FUTURE},
    **{f"{ns} ns old": Forgery(age_ns=ns) for ns in PAST},
    **{f"{ns} ns ahead, unknown session": Forgery(-ns, 99) for ns in FUTURE},
    **{f"{ns} ns old, unknown session": Forgery(ns, 99) for ns in PAST},
    "fresh, of a session that was replaced": Forgery(session=RETIRED),
    "fresh, of another session": Forgery(session=99),
    "fresh, sent again": Forgery(newer=False),
}


def bench_in(mode: Mode, robot: RobotConfig) -> Bench:
    """Return a bench whose planner replaced another one."""
    bench = Bench(robot)
    bench.to_hold()
    bench.cycle(bench.fresh(session=RETIRED))
    bench.run(30)
    assert not bench.controller.failsafe.is_fresh(bench.now_ns, timing_of(robot))
    bench.run(300, fresh=True, hold=mode is Mode.HOLD)
    assert bench.mode is mode
    return bench


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.TRACK])
@pytest.mark.parametrize("forgery", FORGERIES.values(), ids=FORGERIES)
def test_what_cannot_be_a_planners_is_refused_counted_and_moves_nothing(
    forgery: Forgery, mode: Mode, robot: RobotConfig
) -> None:
    """Between good commands, as wild as the limits allow; a twin that is left alone beside it."""
    bench, twin = (bench_in(mode, robot) for _ in range(2))
    before = bench.controller.failsafe.refused
    for n in range(1, 101):
        for one in (bench, twin):
            one.cycle(one.fresh(hold=mode is Mode.HOLD))
        wild = bench.fresh(
            seq=bench.seq + (10_000 if forgery.newer else 0),
            session=forgery.session,
            echo_t_ns=bench.now_ns + bench.cycle_ns - forgery.age_ns,
            **WILD,
        )
        bench.seq = twin.seq
        forged, left_alone = bench.cycle(wild), twin.cycle()
        assert forged == left_alone
        assert bench.controller.state(bench.now_ns).refused == before + n
    assert bench.mode is mode
    assert bench.controller.failsafe.command == twin.controller.failsafe.command


def test_a_planner_restarted_in_its_old_session_is_refused(robot: RobotConfig) -> None:
    """Sessions are drawn at random for this: its numbers begin again, and old ones are refused."""
    bench, twin = (bench_in(Mode.TRACK, robot) for _ in range(2))
    for one in (bench, twin):
        one.run(30)
        assert one.mode is Mode.HOLD
    caught_up, bench.seq = bench.seq, 0
    refused = bench.controller.failsafe.refused
    assert bench.run(caught_up, fresh=True, **WILD) == twin.run(caught_up)
    assert bench.mode is Mode.HOLD
    assert bench.controller.failsafe.refused == refused + caught_up


@pytest.mark.parametrize("uptime_s", [5, 90_000], ids=["restarted host", "same host"])
def test_a_restarted_robot_refuses_its_last_record(uptime_s: int, robot: RobotConfig) -> None:
    """Its services know of no session yet; only the stamps can tell."""
    bench, twin, last = Bench(robot), Bench(robot), Bench(robot)
    last.now_ns = 40_000 * NS_PER_S
    record = [last.fresh(echo_t_ns=last.now_ns + n * 4 * NS_PER_MS, **WILD) for n in range(500)]
    for one in (bench, twin):
        one.now_ns = uptime_s * NS_PER_S
        one.to_hold()
    for n, sent in enumerate(record, 1):
        assert bench.cycle(sent) == twin.cycle()
        assert bench.controller.state(bench.now_ns).refused == n
    assert bench.mode is Mode.HOLD
