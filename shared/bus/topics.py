"""Table of topics: key, type, rate, priority, writers and readers (docs/networks.md)."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import msgspec

from shared.bus import messages, traces
from shared.config.robot_config import SERVICES
from shared.joints import MODULES


class Priority(IntEnum):
    """Bus priority of a topic."""

    REAL_TIME = 1
    DATA = 5
    BACKGROUND = 7


_REAL_TIME, _DATA, _BACKGROUND = Priority

OPERATOR: Final = "operator"
"""Name of a tool that may write: `xrl estop`, `xrl demo`, ..."""
VIEWER: Final = "viewer"
"""Name of a tool that only reads."""
RECORDER: Final = "recorder"
HOST_RECORDER: Final = "host_recorder"
"""Name of the recorder of one host. On the bus it is a tool: it has no endpoint."""
READERS_OF_ALL: Final = (RECORDER, OPERATOR, VIEWER)
PRINCIPALS: Final = (*SERVICES, OPERATOR, VIEWER)
"""Every name that a certificate can have under `mtls`; the network proxy has no certificate."""


class Topic(msgspec.Struct, frozen=True):
    """One row of the table."""

    name: str
    """Key below `xrl/<robot>/`; `*` stands for a module."""
    type: type[messages.Message]
    rate_hz: float
    """Nominal rate, as `deploy/robot.toml` sets it; 0 for events."""
    priority: Priority
    writers: tuple[str, ...]
    """Allowed senders: services, `operator`, or `*`, the module in the key (docs/security.md)."""
    readers: tuple[str, ...]
    """Services that read it; `READERS_OF_ALL` may also read it."""
    why: str
    recorded: bool = True
    batch: Topic | None = None
    """Topic of the batches (`Batch`) that also carry it to the recorder; None: not batched."""
    closes: bool = False
    """True if a message of this topic completes the batch."""

    def key(self, robot: str, module: str = "") -> str:
        """Return the full key, for example `xrl/lab/joint/ankle_right/state`."""
        return f"xrl/{robot}/{self.name.replace('*', module)}"

    @property
    def per_module(self) -> bool:
        """True if there is one key for each module."""
        return "*" in self.name


JOINT_BATCH: Final = Topic(
    "joint/*/batch", traces.Batch, 50.0, _DATA, ("*",), (),
    "states, events and traces, for the recorder", recorded=False,
)  # fmt: skip
JOINT_STATE: Final = Topic(
    "joint/*/state", messages.JointState, 250.0, _REAL_TIME, ("*",), ("planner",),
    "measured state", batch=JOINT_BATCH,
)  # fmt: skip
JOINT_COMMAND: Final = Topic(
    "joint/*/command", messages.JointCommand, 250.0, _REAL_TIME, ("planner",), ("*",),
    "references, gains and torques (recorded in `planner/status`)", recorded=False,
)  # fmt: skip
JOINT_EVENT: Final = Topic(
    "joint/*/event", messages.JointEvent, 0.0, _DATA, ("*",), (),
    "change of mode", batch=JOINT_BATCH, closes=True,
)  # fmt: skip
JOINT_TRACE: Final = Topic(
    "joint/*/trace", traces.JointTrace, 50.0, _BACKGROUND, ("*",), (),
    "inputs of every cycle, for re-execution",
    batch=JOINT_BATCH, closes=True,
)  # fmt: skip
WRENCH: Final = Topic(
    "harness/wrench", messages.Wrench, 250.0, _DATA, ("harness",), ("planner",),
    "wrench on the torso",
)  # fmt: skip
ATTITUDE: Final = Topic(
    "imu/attitude", messages.Attitude, 100.0, _DATA, ("imu",), ("planner",),
    "attitude, if an IMU is fitted",
)  # fmt: skip
HARNESS_TARE: Final = Topic(
    "harness/tare", messages.TareRequest, 0.0, _DATA, (OPERATOR,), ("harness",),
    "zeroing of the harness sensor",
)  # fmt: skip
PLANNER_STATUS: Final = Topic(
    "planner/status", messages.PlannerStatus, 250.0, _DATA, ("planner",), (),
    "inputs, decisions and commands of the law",
)  # fmt: skip
PLANNER_CHECKPOINT: Final = Topic(
    "planner/checkpoint", traces.PlannerCheckpoint, 1.0, _BACKGROUND, ("planner",), (),
    "planner state, for re-execution; at start-up more often",
)  # fmt: skip
OPERATOR_INTENT: Final = Topic(
    "operator/intent", messages.OperatorIntent, 50.0, _DATA, (OPERATOR, "simulator"),
    ("planner", "simulator"), "requests of the person",
)  # fmt: skip
OPERATOR_HAND: Final = Topic(
    "operator/hand", messages.HandLead, 0.0, _DATA, (OPERATOR,), ("simulator",),
    "hand and push on the simulated robot",
)  # fmt: skip
ESTOP: Final = Topic(
    "estop", messages.Estop, 0.0, _REAL_TIME, (OPERATOR,), MODULES,
    "emergency stop",
)  # fmt: skip
SIM_TRUTH: Final = Topic(
    "sim/truth", traces.SimTruth, 100.0, _BACKGROUND, ("simulator",), (),
    "true state, for the verdict",
)  # fmt: skip
SIM_STATE: Final = Topic(
    "sim/state", traces.SimState, 5.0, _BACKGROUND, ("simulator",), (),
    "complete state, for `xrl log whatif`",
)  # fmt: skip
SIM_CONTROL: Final = Topic(
    "sim/control", messages.SimControl, 0.0, _DATA, (OPERATOR,), ("simulator",),
    "start of the scenario",
)  # fmt: skip
RUN_EVENT: Final = Topic(
    "run/event", messages.RunEvent, 0.0, _DATA, (OPERATOR,), (),
    "kills, restarts, faults and pushes, for the verdict",
)  # fmt: skip
LINK_EVENT: Final = Topic(
    "link/event", traces.LinkEvent, 0.0, _DATA, ("network_proxy",), (),
    "deliberate network impairments",
)  # fmt: skip
TOOLS: Final = Topic(
    "recorder/tools", messages.ToolRoster, 2.0, _BACKGROUND, (RECORDER,), (),
    "linked tools, and recording faults",
)  # fmt: skip

TOPICS: Final = tuple(row for row in tuple(globals().values()) if isinstance(row, Topic))
"""All rows above, in order."""

_OF_TOOLS: Final = frozenset(topic.name for topic in TOPICS if OPERATOR in topic.writers)


def several_may_write(key: str) -> bool:
    """Return True if several tools may write a full key, each with its own sequence numbers."""
    return key.split("/", 2)[-1] in _OF_TOOLS


def keys(topic: Topic, robot: str) -> tuple[str, ...]:
    """Return every full key of a topic."""
    if topic.per_module:
        return tuple(topic.key(robot, module) for module in MODULES)
    return (topic.key(robot),)


def keys_by_batch(robot: str) -> dict[str, set[str]]:
    """Return the full keys that each batch may contain, by the batch's full key."""
    found: dict[str, set[str]] = {}
    for topic in TOPICS:
        if topic.batch is not None:
            for module in MODULES:
                batch = topic.batch.key(robot, module)
                found.setdefault(batch, set()).add(topic.key(robot, module))
    return found


def all_keys(robot: str) -> dict[str, Topic]:
    """Return the topic of each full key of a robot."""
    return {key: topic for topic in TOPICS for key in keys(topic, robot)}


def recorded_keys(robot: str) -> dict[str, Topic]:
    """Return the topic of each recorded full key of a robot."""
    return {key: topic for key, topic in all_keys(robot).items() if topic.recorded}


def written_keys(robot: str, name: str) -> tuple[str, ...]:
    """Return the full keys that a service, `operator` or `viewer` may put."""
    return tuple(key for topic in TOPICS for key in _keys_of(topic, robot, name, topic.writers))


def read_keys(robot: str, name: str) -> tuple[str, ...]:
    """Return the full keys that a service, `operator` or `viewer` may receive."""
    if name in READERS_OF_ALL:
        return (f"xrl/{robot}/**",)
    return tuple(key for topic in TOPICS for key in _keys_of(topic, robot, name, topic.readers))


def keys_between(robot: str, writer: str, reader: str) -> tuple[str, ...]:
    """Return the full keys that `writer` may put and `reader` may receive."""
    written = written_keys(robot, writer)
    if reader in READERS_OF_ALL:
        return written
    read = read_keys(robot, reader)
    return tuple(key for key in written if key in read)


def _keys_of(topic: Topic, robot: str, name: str, names: tuple[str, ...]) -> tuple[str, ...]:
    if name in names:
        return keys(topic, robot)
    return (topic.key(robot, name),) if "*" in names and name in MODULES else ()
