"""The fleet's pattern over transports: figures, and the two transports that need no package."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.exceptions import RunError
from tools.lab.bench import bus
from tools.lab.bench.bus import Seen, over_datagrams


def test_figures_are_over_the_commands_of_all_modules() -> None:
    seen: list[Seen] = [([1000.0] * 99, 9, 0.05), ([3000.0], 1, 0.05), ([], 0, 0.05)]
    found = bus.figures("zmq", seen)
    assert found["p50 ms"] == 1.0
    assert found["p99.9 ms"] > 2.5
    assert found["missed %"] == pytest.approx(10.0)
    assert found["CPU %"] == pytest.approx(15.0)
    with pytest.raises(RunError, match="zmq: no command arrived"):
        bus.figures("zmq", [([], 0, 0.0)])


def test_over_datagrams_the_newest_payload_is_taken_once(tmp_path: Path) -> None:
    (_, latest), (publisher, _) = (over_datagrams(name, tmp_path) for name in ("a", "b"))
    put = publisher("state_a")
    put(b"nobody is there yet")
    take = latest("state_a")
    assert take() is None
    for number in range(3):
        put(b"%d" % number)
    assert take() == b"2"
    assert take() is None


@pytest.mark.system
@pytest.mark.parametrize("transport", ["zenoh", "datagrams"])
def test_six_modules_and_a_planner_exchange_states_and_commands(transport: str) -> None:
    found = bus.measure(transport, 2.0)
    assert found["p50 ms"] > 0.0
    assert found["CPU %"] > 0.0


@pytest.mark.system
def test_a_process_that_fails_is_an_error() -> None:
    with pytest.raises(KeyError):
        bus.measure("no-such", 0.1)
