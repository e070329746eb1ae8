"""The one table of topics: key, type, rate, priority, who writes, who reads (docs/networks.md)."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import msgspec

from shared.bus import messages, traces
from shared.joints import MODULES


class Priority(IntEnum):
    """Bus priority of a topic; control goes first."""

    REAL_TIME = 1
    DATA = 5
    BACKGROUND = 7


OPERATOR: Final = "operator"
"""Who leads by a tool: `xrl estop`, `xrl demo`, ..."""
VIEWER: Final = "viewer"
"""Who only looks."""
RECORDER: Final = "recorder"
HOST_RECORDER: Final = "host_recorder"
"""One host's own recorder: on the bus a tool, which listens nowhere."""
READERS_OF_ALL: Final = (RECORDER, OPERATOR, VIEWER)


class Topic(msgspec.Struct, frozen=True, kw_only=True):
    """One row of the table."""

    name: str
    """Key below `xrl/<robot>/`; `*` stands for a module."""
    type: type[messages.Message]
    rate_hz: float
    """Nominal rate, as `deploy/robot.toml` sets it; 0 for events."""
    priority: Priority
    recorded: bool
    writers: tuple[str, ...]
    """Who may put it: services, `operator`, or `*`, the module of the key (docs/security.md)."""
    readers: tuple[str, ...] = ()
    """Services that use it; `READERS_OF_ALL` may read every topic."""
    why: str

    def key(self, robot: str, module: str = "") -> str:
        """Return the full key, for example `xrl/lab/joint/ankle_right/state`."""
        return f"xrl/{robot}/{self.name.replace('*', module)}"

    @property
    def per_module(self) -> bool:
        """True if there is one key for each module."""
        return "*" in self.name


JOINT_STATE: Final = Topic(
    name="joint/*/state",
    type=messages.JointState,
    rate_hz=250.0,
    priority=Priority.REAL_TIME,
    recorded=True,
    writers=("*",),
    readers=("planner",),
    why="the planner's input; its stamp is echoed",
)
JOINT_COMMAND: Final = Topic(
    name="joint/*/command",
    type=messages.JointCommand,
    rate_hz=250.0,
    priority=Priority.REAL_TIME,
    recorded=True,
    writers=("planner",),
    readers=("*",),
    why="references, gains and torques of the law",
)
JOINT_EVENT: Final = Topic(
    name="joint/*/event",
    type=messages.JointEvent,
    rate_hz=0.0,
    priority=Priority.DATA,
    recorded=True,
    writers=("*",),
    why="every change of state, with its cause and torque step",
)
JOINT_TRACE: Final = Topic(
    name="joint/*/trace",
    type=traces.JointTrace,
    rate_hz=50.0,
    priority=Priority.BACKGROUND,
    recorded=True,
    writers=("*",),
    why="every cycle's inputs: a joint service can be re-executed from them, bit for bit",
)
PLANNER_CHECKPOINT: Final = Topic(
    name="planner/checkpoint",
    type=traces.PlannerCheckpoint,
    rate_hz=1.0,
    priority=Priority.BACKGROUND,
    recorded=True,
    writers=("planner",),
    why="the planner's state: re-execution can start here",
)
WRENCH: Final = Topic(
    name="harness/wrench",
    type=messages.Wrench,
    rate_hz=250.0,
    priority=Priority.DATA,
    recorded=True,
    writers=("harness",),
    readers=("planner",),
    why="wrench of the operator on the torso",
)
ATTITUDE: Final = Topic(
    name="imu/attitude",
    type=messages.Attitude,
    rate_hz=100.0,
    priority=Priority.DATA,
    recorded=True,
    writers=("imu",),
    readers=("planner",),
    why="direction of up, where an IMU is fitted",
)
HARNESS_TARE: Final = Topic(
    name="harness/tare",
    type=messages.TareRequest,
    rate_hz=0.0,
    priority=Priority.DATA,
    recorded=True,
    writers=(OPERATOR,),
    readers=("harness",),
    why="request for a new zero of the harness sensor",
)
PLANNER_STATUS: Final = Topic(
    name="planner/status",
    type=messages.PlannerStatus,
    rate_hz=250.0,
    priority=Priority.DATA,
    recorded=True,
    writers=("planner",),
    why="inputs and decisions of the law",
)
OPERATOR_INTENT: Final = Topic(
    name="operator/intent",
    type=messages.OperatorIntent,
    rate_hz=50.0,
    priority=Priority.DATA,
    recorded=True,
    writers=(OPERATOR, "simulator"),
    readers=("planner", "simulator"),
    why="assist and shift that the person requests",
)
OPERATOR_HAND: Final = Topic(
    name="operator/hand",
    type=messages.HandLead,
    rate_hz=0.0,
    priority=Priority.DATA,
    recorded=True,
    writers=(OPERATOR,),
    readers=("simulator",),
    why="leads and pushes the simulated robot by hand; nothing on a real one reads it",
)
ESTOP: Final = Topic(
    name="estop",
    type=messages.Estop,
    rate_hz=0.0,
    priority=Priority.REAL_TIME,
    recorded=True,
    writers=(OPERATOR,),
    readers=MODULES,
    why="emergency stop: every module to DAMP",
)
SIM_TRUTH: Final = Topic(
    name="sim/truth",
    type=messages.SimTruth,
    rate_hz=100.0,
    priority=Priority.BACKGROUND,
    recorded=True,
    writers=("simulator",),
    why="true state of the world, for the verdict; no controller reads it",
)
SIM_STATE: Final = Topic(
    name="sim/state",
    type=traces.SimState,
    rate_hz=10.0,
    priority=Priority.BACKGROUND,
    recorded=True,
    writers=("simulator",),
    why="complete simulated world: `xrl log whatif` continues from it",
)
SIM_CONTROL: Final = Topic(
    name="sim/control",
    type=messages.SimControl,
    rate_hz=0.0,
    priority=Priority.DATA,
    recorded=True,
    writers=(OPERATOR,),
    readers=("simulator",),
    why="starts the scenario",
)
RUN_EVENT: Final = Topic(
    name="run/event",
    type=messages.RunEvent,
    rate_hz=0.0,
    priority=Priority.DATA,
    recorded=True,
    writers=(OPERATOR,),
    why="kills, restarts, faults and pushes, for the verdict",
)
LINK_EVENT: Final = Topic(
    name="link/event",
    type=traces.LinkEvent,
    rate_hz=0.0,
    priority=Priority.DATA,
    recorded=True,
    writers=("network_proxy",),
    why="impairments of the network on purpose: a log without them is no evidence",
)

TOOLS: Final = Topic(
    name="recorder/tools",
    type=messages.ToolRoster,
    rate_hz=2.0,
    priority=Priority.BACKGROUND,
    recorded=True,
    writers=(RECORDER,),
    why="who looks on or leads by a tool, and when",
)

TOPICS: Final = (
    JOINT_STATE,
    JOINT_COMMAND,
    JOINT_EVENT,
    JOINT_TRACE,
    WRENCH,
    ATTITUDE,
    HARNESS_TARE,
    PLANNER_STATUS,
    PLANNER_CHECKPOINT,
    OPERATOR_INTENT,
    OPERATOR_HAND,
    ESTOP,
    SIM_TRUTH,
    SIM_STATE,
    SIM_CONTROL,
    RUN_EVENT,
    LINK_EVENT,
    TOOLS,
)


def several_may_write(key: str) -> bool:
    """Return True for a full key on which several tools may put, each with its own numbers."""
    return key.split("/", 2)[-1] in _OF_TOOLS


_OF_TOOLS: Final = frozenset(topic.name for topic in TOPICS if OPERATOR in topic.writers)


def keys(topic: Topic, robot: str) -> tuple[str, ...]:
    """Return every full key of a topic."""
    if topic.per_module:
        return tuple(topic.key(robot, module) for module in MODULES)
    return (topic.key(robot),)


def all_keys(robot: str) -> dict[str, Topic]:
    """Return the topic of every full key of a robot."""
    return {key: topic for topic in TOPICS for key in keys(topic, robot)}


def written_keys(robot: str, name: str) -> tuple[str, ...]:
    """Return the full keys that a service, `operator` or `viewer` may put."""
    return tuple(key for topic in TOPICS for key in _keys_of(topic, robot, name, topic.writers))


def read_keys(robot: str, name: str) -> tuple[str, ...]:
    """Return the full keys that a service, `operator` or `viewer` may receive."""
    if name in READERS_OF_ALL:
        return (f"xrl/{robot}/**",)
    return tuple(key for topic in TOPICS for key in _keys_of(topic, robot, name, topic.readers))


def keys_between(robot: str, writer: str, reader: str) -> tuple[str, ...]:
    """Return the full keys that one may put and the other may receive."""
    written = written_keys(robot, writer)
    if reader in READERS_OF_ALL:
        return written
    read = read_keys(robot, reader)
    return tuple(key for key in written if key in read)


def _keys_of(topic: Topic, robot: str, name: str, names: tuple[str, ...]) -> tuple[str, ...]:
    if name in names:
        return keys(topic, robot)
    return (topic.key(robot, name),) if "*" in names and name in MODULES else ()
