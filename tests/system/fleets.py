"""A fleet of a test's own: started and stopped, heard on its bus, spoken to by the command line."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from shared.bus import topics
from shared.bus.messages import JointState, Mode, PlannerMode, PlannerStatus
from shared.bus.session import Session, open_session
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.places import CHECKOUT, DEFAULT_CONFIG
from tests.system.stalls import stalled_before_it_began
from tests.waiting import comes_true
from tools.fleet import procfs
from tools.fleet.process_table import FleetOptions
from tools.fleet.supervise import SupervisedFleet

FRESH_S: Final = 0.3
"""A module whose last state is older is silent."""
OF_VERBS: Final = ("/tmp/xrl-demo-", "/tmp/xrl-crash-")
"""Run directories of the fleets that `xrl demo` and `xrl study crash` start."""


def wait_for(truth: Callable[[], object], timeout_s: float = 60.0) -> bool:
    """Return True as soon as it is so; False if it is not in time; a look may cost something."""
    return comes_true(truth, timeout_s, every_s=0.05)


@contextmanager
def started(
    run_dir: Path, *services: str, config: Path = DEFAULT_CONFIG, **options: Any
) -> Iterator[SupervisedFleet]:
    """Start these services, or all, and stop them at the end."""
    given = FleetOptions(services=services or None, **options)
    fleet = SupervisedFleet.start(config, run_dir, given)
    try:
        yield fleet
    finally:
        fleet.stop()


def command(*words: str | Path) -> list[str]:
    return [sys.executable, "-m", "tools.cli", *map(str, words)]


def xrl(
    *words: str | Path, run_dir: Path | None = None, timeout_s: float = 100.0
) -> subprocess.CompletedProcess[str]:
    """Run a verb to its end, perhaps on the fleet of a run directory."""
    place = () if run_dir is None else ("--run-dir", run_dir)
    return subprocess.run(
        command(*words, *place), cwd=CHECKOUT, stdin=subprocess.DEVNULL, capture_output=True,
        text=True, timeout=timeout_s, check=False,
    )  # fmt: skip


def xrl_led(verb: str, out: Path, *flags: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a verb that leads a fleet; skip the test if the machine stalled before it began."""
    done = xrl(*verb.split(), "--out", out, *flags, timeout_s=220.0)
    if stalled_before_it_began(done.returncode, done.stdout + done.stderr, out):
        pytest.skip("this machine stalled so often that the scenario could not begin")
    return done


@contextmanager
def leaving_nothing() -> Iterator[Callable[[], set[str]]]:
    """Assert that verbs leave no process and no run directory; gives what was not there before."""

    def present() -> set[str]:
        folders = {str(path) for path in Path("/tmp").glob("xrl-*-*")}
        return {name for name in folders | procfs.fleets() if name.startswith(OF_VERBS)}

    before = present()
    yield lambda: {name for name in procfs.fleets() if name.startswith(OF_VERBS)} - before
    assert present() <= before


class FleetEar:
    """Hears modules, planner and world of a fleet by links that stay open."""

    def __init__(self, session: Session) -> None:
        self._states = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES}
        self._statuses = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        self._truths = session.latest(topics.SIM_TRUTH, SimTruth)
        self._heard_s: dict[str, float] = {}
        self.states: dict[str, JointState] = {}
        self.truth: SimTruth | None = None
        self.fell = False
        self.planner: PlannerStatus | None = None

    def listen(self) -> None:
        now_s = time.monotonic()
        for module, latest in self._states.items():
            if (state := latest.take()) is not None:
                self.states[module], self._heard_s[module] = state, now_s
        if (truth := self._truths.take()) is not None:
            self.truth, self.fell = truth, self.fell or truth.fallen
        self.planner = self._statuses.take() or self.planner

    def modes(self) -> dict[str, Mode]:
        """Return the modes of the modules that are not silent."""
        self.listen()
        oldest_s = time.monotonic() - FRESH_S
        return {m: Mode(s.mode) for m, s in self.states.items() if self._heard_s[m] > oldest_s}

    def wait_for(self, wanted: Mode | Mapping[str, Mode], timeout_s: float = 40.0) -> float:
        """Wait until modules, or all six, tell their modes from now on; return how long it took."""
        begin_s = time.monotonic()
        modes = dict.fromkeys(MODULES, wanted) if isinstance(wanted, Mode) else dict(wanted)
        self.listen()
        self.states.clear()
        while not self.modes().items() >= modes.items():
            assert not self.fell
            assert time.monotonic() - begin_s < timeout_s, (self.modes(), modes)
            time.sleep(0.005)
        return time.monotonic() - begin_s

    def wait_until_led(self) -> None:
        def leads() -> bool:
            self.listen()
            return self.planner is not None and self.planner.mode == PlannerMode.LEADING

        assert wait_for(leads, timeout_s=60.0), self.planner

    def world(self, after_s: float = 0.0) -> SimTruth:
        """Return the simulated world after a while."""
        until = time.monotonic() + after_s
        while self.truth is None or time.monotonic() < until:
            self.listen()
            time.sleep(0.005)
        return self.truth


@contextmanager
def heard(robot: RobotConfig, run_dir: Path) -> Iterator[FleetEar]:
    with open_session(robot, "test", run_dir) as session:
        yield FleetEar(session)
