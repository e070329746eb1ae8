"""Runs one case of the crash matrix on a live fleet of its own."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from services.simulator.physics.plant import PlantConfig
from shared.bus import topics
from shared.bus.codec import Decoder
from shared.bus.messages import JointEvent, RunEvent, RunEventKind
from shared.bus.session import Session
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError, RunError
from shared.joints import MODULES
from tools.fleet.supervise import SupervisedFleet
from tools.fleet.supervisor_client import ServiceInfo
from tools.lab.studies.crash.cases import CrashCase, CrashVerdict, scenario_of
from tools.lab.studies.crash.outcome import (
    CrashMessages,
    CrashResult,
    as_expected,
    measure,
    unjudged,
)
from tools.live.live import run_live
from tools.live.scenario_runner import LiveSnapshot, ScenarioRunner

Show = Callable[[LiveSnapshot], None]

TRIES: Final = 2
"""A run that was disturbed by the machine, or could not be carried out, is made again; not one in
which the robot fell: a fall stays a fall, and its log is kept."""


class Witness:
    """Keeps the bus messages that the verdict needs, beside the recorder."""

    def __init__(self, session: Session, show: Show) -> None:
        self.truth: list[SimTruth] = []
        self.events: list[tuple[str, JointEvent]] = []
        self.modes: tuple[str, ...] = ("-",) * len(MODULES)
        self._modules = {topics.JOINT_EVENT.key(session.robot, name): name for name in MODULES}
        self._stream = session.stream([topics.JOINT_EVENT.key(session.robot, "*")])
        self._decoder = Decoder(JointEvent)
        self._show = show

    def see(self, snapshot: LiveSnapshot) -> None:
        """Take in a moment of the run, and pass it on."""
        if snapshot.truth is not None:
            self.truth.append(snapshot.truth)
        self.modes = snapshot.modes
        self.listen()
        self._show(snapshot)

    def listen(self) -> None:
        """Take in the changes of mode that have come."""
        while (sample := self._stream.take()) is not None:
            event = self._decoder.decode(sample[1])
            if event is not None:
                self.events.append((self._modules[sample[0]], event))


def run_case(
    case: CrashCase,
    robot: RobotConfig,
    out: Path,
    show: Show,
    *,
    seed: int = 0,
) -> CrashResult:
    """Run a case, a second time if the first was disturbed and the robot stood.

    Its folder `out` is made here; `show` sees the run as it goes on.
    """
    begin_s = time.monotonic()
    tries = 0
    while tries < TRIES:
        tries += 1
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        outcome = _run_once(case, robot, out, show, seed)
        judged = outcome.in_real_time and outcome.verdict is not CrashVerdict.UNJUDGED
        if judged or outcome.verdict is CrashVerdict.FELL:
            break
    wall_s = time.monotonic() - begin_s
    outcome = msgspec.structs.replace(outcome, tries=tries, wall_s=wall_s)
    if as_expected(case, outcome) and outcome.verdict is not CrashVerdict.FELL:
        for log in out.glob("*.mcap"):
            log.unlink()  # 6 MB each, and there is nothing to look for in it
    return outcome


def _run_once(case: CrashCase, robot: RobotConfig, out: Path, show: Show, seed: int) -> CrashResult:
    scenario = scenario_of(case)
    down = {row.service for row in scenario.kill}

    def lead(fleet: SupervisedFleet, session: Session) -> CrashMessages:
        witness = Witness(session, show)
        conductor = ScenarioRunner(fleet, session, scenario, witness.see, case.triggered_kill)
        conductor.run()
        witness.listen()
        died = died_of(fleet.info(), conductor.said)
        return CrashMessages(witness.truth, witness.events, conductor.said, witness.modes, died)

    try:
        run = run_live(
            out,
            robot,
            scenario,
            lead,
            verb="crash",
            seed=seed,
            true_plant=PlantConfig(),
            no_restart=down,
        )
    except (RunError, FleetError) as error:
        lines = str(error).splitlines()  # a service's log ends with its error
        return unjudged(": ".join(dict.fromkeys((lines[0], lines[-1].strip()))))
    return measure(case, run, robot)


def died_of(services: Sequence[ServiceInfo], actions: Sequence[RunEvent]) -> list[str]:
    """Return the services that ended without a request, by their states and the actions on them."""
    last = {row.subject: row.kind for row in actions}
    return [
        service.name
        for service in services
        if (service.pid is None and last.get(service.name) != RunEventKind.KILLED)
        or (service.restarts > 0 and service.name not in last)
    ]
