"""Leads a live fleet on three hosts through cuts of its network; what test_namespaces starts.

One host has planner, harness, recorder, simulator and the tool that leads, which is this
process; each leg's host has its three joint services, and the left one a record of them. Emulated
drives are reached through UNIX sockets, which no cut reaches, as a leg's real drives are on wires
of their own.

    unshare --net python -m tests.system.multihost OUT RUN_DIR PARENT_PID

leaves in OUT the record, the services' logs, and what was cut and when (`Report`).
"""

from __future__ import annotations

import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any, Final

import msgspec
import tomli_w

from services.simulator.physics.plant import PlantConfig
from shared.bus.session import open_session
from shared.bus.topics import HOST_RECORDER
from shared.clock import now_ns
from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Push, Scenario
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tests.certified import certified
from tests.system.namespaces import Network
from tools.fleet import process_table
from tools.fleet.pace import run_at_fitting_pace
from tools.fleet.process_table import FleetOptions
from tools.fleet.procfs import die_with_parent
from tools.fleet.supervise import SupervisedFleet
from tools.live import experiment
from tools.live.scenario_runner import LiveSnapshot, ScenarioRunner

BODY: Final = "body"
LEGS: Final = {
    side: tuple(module for module in MODULES if module.endswith(f"_{side}"))
    for side in ("right", "left")
}
"""The hosts beside `BODY`, and what runs there."""

RECORDED: Final = "left"
"""The host that has a record of its own, in a folder of that name beside the fleet's."""
REPORT: Final = "report.json"
STEADY_S: Final = 1.0
"""All six modules track for so long before a cut, and after the last."""
_ALL_TRACK: Final = ("T",) * len(MODULES)
_FIRST_PORT: Final = 7447


class Cut(msgspec.Struct):
    """A host that is alone for a while."""

    host: str
    duration_s: float
    pulled: bool
    """True: its cable is pulled. False: the switch loses its frames, and no carrier shows it."""
    down_ns: int = 0
    """Monotonic clock, the same for all: no frame passes after this."""
    up_ns: int = 0
    """From here on frames may pass again; 0: they never did."""


class Report(msgspec.Struct):
    """What test_namespaces needs to know beside the record."""

    namespaces: list[str]
    cuts: list[Cut]
    finished_ns: int = 0
    """When all six tracked again after the last cut; 0: they did not."""


def cuts() -> list[Cut]:
    """Return what is cut: with a lease of 1 s, one link outlives its cut and two do not."""
    return [
        Cut("right", 0.4, pulled=False),
        Cut("left", 2.0, pulled=True),
        Cut(BODY, 2.0, pulled=False),
    ]


class _FinishedError(Exception):
    """Every cut has been made and survived."""


class Cutter:
    """Makes the cuts one after the other, each once all six modules track steadily."""

    def __init__(self, network: Network, report: Report) -> None:
        self._network = network
        self._report = report
        self._tracking = False
        self._course = self._make_all()

    def see(self, snapshot: LiveSnapshot) -> None:
        """Do what is due; the conductor calls this with each news of the simulated world."""
        self._tracking = snapshot.modes == _ALL_TRACK
        if snapshot.truth is not None and snapshot.truth.scenario_s >= 0.0:
            next(self._course)

    def _make_all(self) -> Iterator[None]:
        for cut in self._report.cuts:
            yield from self._until_steady()
            self._set(cut, joined=False)
            cut.down_ns = now_ns()
            # Not by the bus, which the cut itself may silence.
            mender = threading.Timer(cut.duration_s, self._mend, (cut,))
            mender.daemon = True
            mender.start()
            while mender.is_alive():
                yield
        yield from self._until_steady()
        self._report.finished_ns = now_ns()
        raise _FinishedError

    def _until_steady(self) -> Iterator[None]:
        since = time.monotonic()
        while time.monotonic() - since < STEADY_S:
            yield
            if not self._tracking:
                since = time.monotonic()

    def _mend(self, cut: Cut) -> None:
        cut.up_ns = now_ns()
        self._set(cut, joined=True)

    def _set(self, cut: Cut, *, joined: bool) -> None:
        if cut.pulled:
            self._network.plug(cut.host, plugged=joined)
        else:
            self._network.forward(cut.host, forwarded=joined)


def host_of(service: str) -> str:
    """Return where a service runs."""
    if service == HOST_RECORDER:
        return RECORDED
    return next((leg for leg, modules in LEGS.items() if service in modules), BODY)


def spread(robot: RobotConfig, network: Network, folder: Path) -> RobotConfig:
    """Return the robot with every bus endpoint on its host, under `mtls`."""
    endpoints = {
        service: f"tls/{network.address(host_of(service))}:{port}"
        for port, service in enumerate(robot.bus.endpoints, start=_FIRST_PORT)
    }
    return certified(robot, folder, endpoints)[0]


def write_table(path: Path, network: Network) -> Path:
    """Write the process table with each command on its host."""
    table: dict[str, Any] = msgspec.to_builtins(process_table.load_table())
    for row in table["process"]:
        row["command"] = [*network.entering(host_of(row["name"])), *row["command"]]
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    return path


def scenario() -> Scenario:
    """Return the squat, led by the operator throughout and pushed every two seconds."""
    squat = scenarios.load(experiment.scenario_file("squat"))
    pushes = [Push(at=t, duration=0.2, force=(25.0, 0.0, 0.0)) for t in range(2, 40, 2)]
    return msgspec.structs.replace(
        squat, duration=40.0, kill=(), restart=(), fault=(), push=tuple(pushes)
    )


def lead(out: Path, run_dir: Path, network: Network, report: Report, pace: float) -> None:
    """Start the fleet, cut and mend, stop the fleet.

    Args:
        out: for the record, what it is made from, and the services' logs; absolute.
        run_dir: for sockets; short.
        network: of the hosts.
        report: what to cut; when, and whether the robot led again, is written into it.
        pace: clock rate of the fleet.
    """
    # Before it starts a service, the supervisor tries whether its endpoint can be bound.
    network.allow_foreign_addresses()
    keyring = run_dir.parent / "keyring"
    shutil.rmtree(keyring, ignore_errors=True)  # of an earlier try
    robot = spread(experiment.load_robot(DEFAULT_CONFIG), network, keyring)
    told = scenario()
    robot_path, scenario_path, *_ = experiment.write_inputs(out, robot, told, PlantConfig())
    options = FleetOptions(
        overrides={
            "recorder": ["--out", str(out), "--scenario", str(scenario_path)],
            HOST_RECORDER: ["--out", str(out / RECORDED), "--of", ",".join(LEGS[RECORDED])],
            "simulator": ["--scenario", str(scenario_path)],
        },
        services=(*(name for name in robot.services if name != "imu"), HOST_RECORDER),
        leashed=True,
        pace=pace,
        table_path=write_table(out / "processes.toml", network),
    )
    started = SupervisedFleet.start(robot_path, run_dir, options)
    try:
        with open_session(robot, "multihost", run_dir) as session:
            try:
                ScenarioRunner(started, session, told, Cutter(network, report).see).run()
            except _FinishedError:
                return
    finally:
        started.stop(keep_logs=True)
        shutil.copytree(started.run.logs, out / "logs", dirs_exist_ok=True)


def main() -> None:
    """Run as the module's docstring says; end with the process that started this one."""
    out, run_dir, parent_pid = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    signal.signal(signal.SIGTERM, _leave)
    die_with_parent(parent_pid, signal.SIGTERM)

    def again(text: str) -> None:
        for record in out.rglob("run*.mcap"):
            record.unlink()  # of a robot that stood and waited
        sys.stdout.write(f"{text}\n")

    with Network((BODY, *LEGS)) as network:
        report = Report(network.namespaces(), cuts())
        (out / REPORT).write_bytes(msgspec.json.encode(report))
        try:
            run_at_fitting_pace(lambda pace: lead(out, run_dir, network, report, pace), again)
        finally:
            (out / REPORT).write_bytes(msgspec.json.encode(report))


def _leave(number: int, _frame: FrameType | None) -> None:
    """Leave as if by an exception, so that the fleet is stopped."""
    sys.exit(128 + number)


if __name__ == "__main__":
    main()
