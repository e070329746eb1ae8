"""Stamps that cannot be, sessions that are over, commands that come again: refused and counted.

An age is measured on one clock, the host's monotonic (docs/architecture.md#age-rule): a
clock that cannot step. Runs with clocks of several hosts: `tests/lockstep/test_clocks.py`.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import NamedTuple

import pytest

from shared.bus.messages import Mode
from shared.clock import NS_PER_MS, NS_PER_S
from tests.joint.helpers import SESSION, TIMING, Bench
from tests.robots import ROBOT

ROOT = Path(__file__).resolve().parents[2]
HOUR_NS = 3600 * NS_PER_S
WILD = {"q_ref": (0.3, -2.5), "k_p": (3000.0, 3000.0), "tau_ff": (50.0, -50.0)}
"""Within every limit: taken, it would throw the module."""
RETIRED = SESSION - 1


def test_no_service_that_controls_reads_the_time_of_day() -> None:
    """So that whatever steps it (NTP, a person, a battery that is empty) changes nothing."""
    of_day = {"time", "time_ns", "now", "utcnow", "today", "gettimeofday", "CLOCK_REALTIME"}
    rooms = [ROOT / "services" / room for room in ("joint", "planner", "harness")]
    paths = [path for room in rooms for path in room.rglob("*.py")]
    paths += [
        ROOT / "shared" / name
        for name in ("clock.py", "bus/pubsub.py", "bus/session.py", "bus/codec.py")
    ]
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


FUTURE = [1, NS_PER_MS, NS_PER_S, HOUR_NS, 24 * HOUR_NS, 1 << 61]
PAST = [50 * NS_PER_MS + 1, 51 * NS_PER_MS, NS_PER_S, HOUR_NS, 24 * HOUR_NS, 1 << 61]
FORGERIES = {
    f"{ns} ns old, session {session}": Forgery(ns, session)
    for ns in (*PAST, *(-ns for ns in FUTURE))
    for session in (SESSION, 99)
} | {
    "fresh, of a session that was replaced": Forgery(session=RETIRED),
    "fresh, of another session": Forgery(session=99),
    "fresh, sent again": Forgery(newer=False),
}


def bench_in(mode: Mode) -> Bench:
    """Return a bench whose planner replaced another one."""
    bench = Bench(ROBOT)
    bench.to_hold()
    bench.cycle(bench.fresh(session=RETIRED))
    bench.run(30)
    assert not bench.controller.failsafe.is_fresh(bench.now_ns, TIMING)
    bench.run(300, fresh=True, hold=mode is Mode.HOLD)
    assert bench.mode is mode
    return bench


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.TRACK])
@pytest.mark.parametrize("forgery", FORGERIES.values(), ids=FORGERIES)
def test_what_cannot_be_a_planners_is_refused_counted_and_moves_nothing(
    forgery: Forgery, mode: Mode
) -> None:
    """Between good commands, as wild as the limits allow; a twin that is left alone beside it.

    So is a record of the same robot, in the same session and pose, played by somebody: it is older
    or, if the host has restarted since, ahead.
    """
    bench, twin = (bench_in(mode) for _ in range(2))
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
        assert bench.law.state(bench.controller, bench.now_ns).refused == before + n
    assert bench.mode is mode
    assert bench.controller.failsafe.command == twin.controller.failsafe.command
