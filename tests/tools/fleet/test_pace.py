"""A simulated fleet on cores that do not carry it: one slower clock for all of its processes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared import clock
from shared.bus.messages import Mode
from shared.bus.traces import SimTruth
from shared.exceptions import FleetError
from shared.joints import MODULES
from shared.run_directory import make_live_dir
from tests.messages import filled
from tools.fleet import pace
from tools.fleet.pace import CoresFullError, check_pace
from tools.fleet.process_table import FleetOptions
from tools.live import live, scenario_runner
from tools.live.scenario_runner import ScenarioRunner


@pytest.fixture(autouse=True)
def _real_time_again(tmp_path: Path) -> Iterator[None]:
    yield
    clock.keep_pace(tmp_path / "no fleet")


def test_a_fleet_in_slow_motion_reads_a_slower_clock_and_waits_for_longer(tmp_path: Path) -> None:
    (make_live_dir(tmp_path) / clock.PACE_FILE).write_text("0.5\n")
    clock.keep_pace(tmp_path)
    machine_ns = time.monotonic_ns()
    assert clock.now_ns() == pytest.approx(0.5 * machine_ns, abs=1e9)
    assert clock.machine_s(0.02) == 0.04
    begin_s = time.monotonic()
    clock.sleep_until(clock.now_ns() + 20 * clock.NS_PER_MS)
    assert time.monotonic() - begin_s >= 0.04


def test_a_fleet_without_a_pace_goes_by_the_machines_clock(tmp_path: Path) -> None:
    (make_live_dir(tmp_path) / clock.PACE_FILE).write_text("0.5\n")
    clock.keep_pace(tmp_path)
    clock.keep_pace(tmp_path / "another")
    before_ns = time.monotonic_ns()
    assert before_ns - clock.NS_PER_US < clock.now_ns() <= time.monotonic_ns()


@pytest.mark.parametrize("text", ["", "fast", "0", "-1", "1.5", "nan", "inf"])
def test_a_file_without_a_pace_is_refused(tmp_path: Path, text: str) -> None:
    (make_live_dir(tmp_path) / clock.PACE_FILE).write_text(text)
    with pytest.raises(FleetError, match="is not a valid pace"):
        clock.keep_pace(tmp_path)


@pytest.mark.parametrize(
    ("value", "simulated", "words"),
    [
        (0.5, False, "only a simulated fleet"),
        *((value, True, "must be between") for value in (0.0, 0.05, 1.01, float("nan"))),
    ],
)
def test_a_pace_that_cannot_be_kept_is_refused(value: float, simulated: bool, words: str) -> None:
    check_pace(0.5, simulated=True)
    check_pace(1.0, simulated=False)
    with pytest.raises(FleetError, match=words):
        check_pace(value, simulated=simulated)


class Machine:
    """Carries a fleet up to some pace."""

    def __init__(self, carries: float) -> None:
        self.carries = carries
        self.paces: list[float] = []

    def run_once(
        self, _out: Path, _robot: object, _path: object, options: FleetOptions, *_: object
    ) -> str:
        assert options.pace is not None
        self.paces.append(options.pace)
        if options.pace > self.carries:
            raise CoresFullError("full")
        return "led"


def run_live(
    machine: Machine,
    monkeypatch: pytest.MonkeyPatch,
    out: Path,
    asked: float | None,
    told: list[str],
) -> str:
    monkeypatch.setattr(live, "_prepare", lambda *_: (None, {}))
    monkeypatch.setattr(live, "_run_once", machine.run_once)
    return live.run_live(
        out, None, None, None,  # type: ignore[arg-type]  # the machine takes them
        verb="demo", seed=0, true_plant=None, no_restart=(), pace=asked, tell=told.append,  # type: ignore[arg-type]
    )  # fmt: skip


def test_where_the_cores_are_full_the_fleet_runs_slower_and_so_do_those_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(pace.PACE_VARIABLE, "1")
    machine, told = Machine(carries=0.5), list[str]()
    (tmp_path / "run.mcap").touch()
    assert run_live(machine, monkeypatch, tmp_path, None, told) == "led"
    assert machine.paces == [1.0, 0.6, 0.36]
    assert len(told) == 2
    assert not (tmp_path / "run.mcap").exists(), "nothing of the tries is left"
    run_live(machine, monkeypatch, tmp_path, None, told)
    assert machine.paces[3:] == [0.36]


@pytest.mark.parametrize(("asked", "carries"), [(1.0, 0.5), (None, 0.0)])
def test_a_pace_that_was_asked_for_is_kept_and_no_pace_ends_the_tries(
    asked: float | None, carries: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(pace.PACE_VARIABLE, "1")
    machine = Machine(carries)
    with pytest.raises(CoresFullError):
        run_live(machine, monkeypatch, tmp_path, asked, [])
    assert machine.paces == [1.0] if asked else min(machine.paces) >= pace.PACE_MIN


@pytest.mark.parametrize("idle", [0.0, 0.25])
def test_the_cores_are_judged_while_the_robot_stands_before_the_scenario(
    monkeypatch: pytest.MonkeyPatch, idle: float
) -> None:
    """However soon it stands: the start alone says nothing of the cores."""
    runner = object.__new__(ScenarioRunner)
    runner._modes = dict.fromkeys(MODULES, int(Mode.TRACK))
    runner._truth = filled(SimTruth, {bool: False, int: 0, float: 0.0})
    runner._tell = print
    monkeypatch.setattr(runner, "_listen", lambda: None)
    monkeypatch.setattr(scenario_runner, "SETTLE_S", 0.05)
    monkeypatch.setattr(scenario_runner, "idle_share", lambda _before: idle)
    if idle:
        assert runner._wait_until_tracking(lambda: False)
        return
    with pytest.raises(CoresFullError, match="0 % idle"):
        runner._wait_until_tracking(lambda: False)
