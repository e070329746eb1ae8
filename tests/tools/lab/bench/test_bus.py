"""The fleet's pattern over transports: figures from reports, and the two that need no package."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.exceptions import RunError
from tools.lab.bench import bus
from tools.lab.bench.bus import BusFigures
from tools.lab.bench.bus_process import PLANNER, BusReport
from tools.lab.bench.transports import TRANSPORTS, installed, over_datagrams


def report(name: str, latency_us: list[float], **changes: object) -> BusReport:
    return BusReport(name, cpu_s=0.5, wall_s=10.0, latency_us=latency_us, **changes)  # type: ignore[arg-type]


def test_figures_are_over_the_commands_of_all_modules() -> None:
    reports = [
        report("knee_left", [1000.0] * 99, missed=9, lost=1),
        report("knee_right", [3000.0], missed=1),
        report(PLANNER, []),
    ]
    found = bus.figures("zmq", reports)
    assert found.p50_us == 1000.0
    assert found.p999_us > 2500.0
    assert found.missed == pytest.approx(0.1)
    assert found.lost == pytest.approx(1 / 101)
    assert found.cpu == pytest.approx(0.15)


def test_a_transport_over_which_nothing_came_is_an_error() -> None:
    with pytest.raises(RunError, match="zmq: no command arrived"):
        bus.figures("zmq", [report("knee_left", [])])


def test_rounds_are_summed_up_by_their_medians() -> None:
    rounds = [BusFigures("zmq", us, 1.0, 1.0, 0.0, 0.0, us / 10.0) for us in (3.0, 1.0, 2.0)]
    assert bus.median_of(rounds) == BusFigures("zmq", 2.0, 1.0, 1.0, 0.0, 0.0, 0.2)


def test_what_needs_no_package_is_always_installed() -> None:
    assert {"zenoh", "datagrams"} <= set(installed())
    assert set(installed()) <= {row.name for row in TRANSPORTS}


def test_over_datagrams_the_newest_payload_is_taken_once(tmp_path: Path) -> None:
    reader, writer = (over_datagrams(name, tmp_path) for name in ("a", "b"))
    put = writer.publisher("state/a")
    put(b"nobody is there yet")
    take = reader.latest("state/a")
    assert take() is None
    for number in range(3):
        put(b"%d" % number)
    assert take() == b"2"
    assert take() is None
    reader.close()
    put(b"nobody is there any more")
    writer.close()


@pytest.mark.system
@pytest.mark.parametrize("transport", ["zenoh", "datagrams"])
def test_six_modules_and_a_planner_exchange_states_and_commands(transport: str) -> None:
    found = bus.measure(transport, 2.0)
    assert found.p50_us > 0.0
    assert found.cpu > 0.0
    assert found.lost < 0.5


@pytest.mark.system
def test_a_process_that_fails_is_an_error_with_its_last_line() -> None:
    with pytest.raises(RunError, match="no-such: a process ended with 1: KeyError"):
        bus.measure("no-such", 0.1)
