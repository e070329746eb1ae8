"""What may not be put on the live keys of a robot that may move."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from shared.bus import security, topics
from shared.bus.messages import JointState
from shared.bus.session import open_session
from shared.bus.topics import Topic
from shared.config.robot_config import RobotConfig, expand
from shared.exceptions import FleetError
from shared.joints import MODULES
from tools.fleet.process_table import is_listening
from tools.fleet.supervise import SupervisedFleet
from tools.topic_keys import LIVE, match, row_of, short

IN_THE_LOOP: Final = (topics.JOINT_STATE, topics.JOINT_COMMAND, topics.WRENCH, topics.ATTITUDE)
"""Topics that move a robot: never published beside a live drive, even with --force.

A recorded command is too old for a joint service, unless the machine has restarted and its clock
passes the time of the recording again. From recorded states and wrenches the planner makes fresh
commands.
"""

ACTED_ON: Final = (
    *IN_THE_LOOP,
    topics.OPERATOR_INTENT,
    topics.OPERATOR_HAND,
    topics.ESTOP,
    topics.HARNESS_TARE,
    topics.SIM_CONTROL,
)
"""Topics to which live services subscribe, but for the recorder."""

LISTEN_S: Final = 1.0
"""So long a joint service is listened for: it says its state 250 times a second."""
_POLL_S: Final = 0.01


def those_of(rows: Iterable[Topic], keys: Iterable[str]) -> list[str]:
    """Return the live keys that belong to some topics, of whatever robot."""
    names = [f"{LIVE}/*/{row.name}" for row in rows]
    return [key for key in keys if any(match(name, key) for name in names)]


class LiveRobotWatch:
    """Listens for a live robot in a session of its own, which does not receive the player."""

    def __init__(self, robot: RobotConfig, run_dir: Path) -> None:
        self._robot, self._run_dir = robot, run_dir
        self._session = open_session(robot, "play-watch", run_dir)
        self._states = {
            module: self._session.latest(topics.JOINT_STATE, JointState, module)
            for module in MODULES
        }

    def close(self) -> None:
        """Leave the bus."""
        self._session.close()

    def find_live(self) -> str:
        """Return why a live drive is taken to be on the bus, in words; empty if it is not."""
        try:
            fleet = SupervisedFleet.attach(self._run_dir)
        except FleetError:
            pass
        else:
            if set(fleet.manifest.services) & set(MODULES):
                return f"the fleet in {fleet.run.path} has joint services"
        here = security.services_here(self._robot)
        for module in MODULES:
            at = security.endpoint_here(self._robot, module, here)
            endpoint = expand(at, self._run_dir)
            if is_listening(endpoint):
                return f"the joint service {module} listens on {endpoint}"
        deadline = time.monotonic() + LISTEN_S
        while time.monotonic() < deadline:
            if subscribers := self.subscribers():
                return subscribers
            time.sleep(_POLL_S)
        return ""

    def subscribers(self) -> str:
        """Return the joint services that have sent since the last call, as text."""
        for module, states in self._states.items():
            if states.take() is not None or states.refused:
                return f"the joint service {module} is heard"
        return ""


def allowed(targets: Mapping[str, str], live: str, *, force: bool) -> dict[str, str]:
    """Return the keys that may be published beside what `LiveRobotWatch.find_live` found.

    `force` adds topics that a live robot acts on, but for those that move it (else FleetError).
    """
    refused = set(those_of(IN_THE_LOOP if force else ACTED_ON, targets.values()))
    if not live or not refused:
        return dict(targets)
    if not force:
        raise FleetError(
            f"{live}, and it acts on {describe(refused)}: leave these out with --exclude, play "
            "under a --prefix, or --force"
        )
    left = {key: target for key, target in targets.items() if target not in refused}
    if not left:
        raise FleetError(
            f"{live}: {describe(refused)} would move it, and is not put even with --force; "
            "play under a --prefix, or `xrl down` first"
        )
    return left


def describe(keys: Iterable[str]) -> str:
    """Return live keys as topics, each once."""
    return ", ".join(sorted({row_of(short(key)) for key in keys}))
