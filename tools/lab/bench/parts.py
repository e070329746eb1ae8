"""The parts of the fleet that `xrl bench` times, each with its inputs from a recorded squat.

A loop that calls a function a thousand times in a row finds its code and data in the cache. In the
fleet each cycle follows a sleep, and ten processes share two cores: a planner tick of 294 us warm
took 568 us live. Before a cold call the bench sweeps more memory than a core's own cache holds, and
sleeps; this reproduced the live figure. Times are the calling thread's CPU time.
"""

from __future__ import annotations

import functools
import itertools
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from services.joint.drive_manager import DriveAction, DriveManager
from services.joint.drivers.odrive_can import OdriveCan
from services.planner.planner import Planner
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.bus import topics
from shared.bus.codec import Decoder, encode
from shared.bus.messages import JointCommand, JointState, Message, Tare, Wrench
from shared.bus.topics import Topic
from shared.can import cansimple
from shared.can.cansimple import Command
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.config.sections import CanConfig
from shared.joints import MODULES
from shared.mcap_log.writer import RunWriter
from tools.lab.bench.table import Figure, Turn
from tools.sim.lockstep import Lockstep, begin_standing, forget
from tools.sim.recorded_lockstep import DRAIN_EVERY, RecordedMessages

SECONDS: Final = 3.0
"""Recorded part of the squat, down and up, s."""
PIECE_S: Final = 0.5
"""Virtual time of a lockstep run for one figure, s."""
CHUNK: Final = 600
"""Messages per chunk; the recorder writes one every 250 ms."""
MODULE: Final = "knee_right"


SWEPT_BYTES: Final = 6 << 20
"""Read and written before each cold call."""
ASLEEP_S: Final = 1.5e-3
"""Sleep before each cold call, s: most of a joint service's cycle."""
CALLS: Final = {"warm": 200, "cold": 60}
"""Calls of each part per turn; they take a few tenths of a second."""
YARDSTICK_CALLS: Final = 20


class Repeated(NamedTuple):
    """A call to measure."""

    once: Callable[[], object]
    """The timed call."""
    before: Callable[[], object] | None = None
    """Prepares each call, untimed."""


def measure(repeated: Repeated, calls: int, *, cold: bool = False) -> float:
    """Return the median CPU time of a call, us; `cold`: sweep the cache and sleep before each."""
    once, before = repeated.once, repeated.before
    swept = np.zeros(SWEPT_BYTES, dtype=np.uint8)
    times_ns = np.empty(calls)
    for call in range(calls):
        if before is not None:
            before()
        if cold:
            np.add(swept, 1, out=swept)
            time.sleep(ASLEEP_S)
        begin_ns = time.thread_time_ns()
        once()
        times_ns[call] = time.thread_time_ns() - begin_ns
    return 1e-3 * float(np.median(times_ns))


class JointInputs(NamedTuple):
    """Arguments and outcome of one cycle of a joint service."""

    arguments: tuple[Any, ...]
    action: DriveAction


class Recorded(NamedTuple):
    """A squat in virtual time, with the inputs of each part."""

    robot: RobotConfig
    ticks: list[tuple[int, list[JointState]]]
    """Time of each planner tick, ns, and the six states that the tick used."""
    cycles: list[JointInputs]
    """Cycles of `MODULE`'s service."""
    messages: list[tuple[Topic, str, Message]]
    """All messages for the recorder."""
    fleet: Lockstep
    """The fleet after the recording."""


def record(robot: RobotConfig, scenario: Scenario) -> Recorded:
    """Run the fleet in virtual time and keep the inputs of its parts."""
    latest: dict[str, JointState] = {}
    ticks: list[tuple[int, list[JointState]]] = []
    messages: list[tuple[Topic, str, Message]] = []

    def take(topic: Topic, module: str, message: Message) -> None:
        if topic.recorded:
            messages.append((topic, module, message))
        if isinstance(message, JointState):
            latest[module] = message
        elif topic is topics.PLANNER_STATUS and len(latest) == len(MODULES):
            ticks.append((message.t_ns, [latest[name] for name in MODULES]))

    fleet = Lockstep(robot, scenario, record=take)
    joint = fleet.joints[MODULES.index(MODULE)]
    kept = _KeptManager(robot, MODULE)
    joint.manager = kept
    started = begin_standing(fleet)
    for truth in fleet.run():
        if not started and truth.scenario_s >= 0.0:
            started = True
            ticks.clear()
            kept.cycles.clear()
            messages.clear()
        if truth.scenario_s >= SECONDS:
            break
    return Recorded(robot, ticks, kept.cycles, messages, fleet)


class _KeptManager(DriveManager):
    """A drive manager that keeps its inputs and actions."""

    def __init__(self, config: RobotConfig, name: str) -> None:
        super().__init__(config, name)
        self.cycles: list[JointInputs] = []

    def step(self, *arguments: Any) -> DriveAction:
        action = super().step(*arguments)
        self.cycles.append(JointInputs(arguments, action))
        return action


def _planner_tick(recorded: Recorded, _stack: ExitStack, split: str = "certified") -> Repeated:
    """Time a planner tick, from six states to six commands and a status, while the hand leads."""
    law = msgspec.structs.replace(recorded.robot.law, split=split)
    planner = Planner(msgspec.structs.replace(recorded.robot, law=law), session=1)
    inputs = itertools.cycle(recorded.ticks)
    wrench = Wrench(
        t_ns=0, seq=0, force=(0.0, 0.0, -20.0), moment=(0.0, 0.0, 0.0), valid=True,
        saturated=False, tare=int(Tare.DONE), age_ns=0,
    )  # fmt: skip

    def once() -> None:
        now_ns, states = next(inputs)
        planner.receive_wrench(wrench, now_ns)
        for module, state in enumerate(states):
            planner.receive_state(module, state, now_ns)
        planner.tick(now_ns)
        planner.status(now_ns, 0.0)

    return Repeated(once)


def _joint_cycle(recorded: Recorded, _stack: ExitStack) -> Repeated:
    """Time a cycle from command JSON and sample to target and, every other cycle, state JSON."""
    manager, decoder = DriveManager(recorded.robot, MODULE), Decoder(JointCommand)
    arguments = [one.arguments for one in recorded.cycles]
    payloads = [b"" if command is None else encode(command) for _, _, command, *_ in arguments]
    inputs = itertools.cycle(zip(payloads, arguments, strict=True))
    count = itertools.count()

    def once() -> None:
        payload, (now_ns, reading, _, estop, *near) = next(inputs)
        command = decoder.decode(payload) if payload else None
        manager.step(now_ns, reading, command, estop, *near)
        if next(count) % 2 == 0:
            encode(manager.controller.state(manager.state.controller, now_ns))

    return Repeated(once)


def _drive_exchange(recorded: Recorded, stack: ExitStack) -> Repeated:
    """Time reading two encoder frames and writing a target over the simulator's CAN bus."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="xrl-bench-")))
    hub = stack.enter_context(UnixCanHub(folder / "can"))
    nodes = recorded.robot.module_named(MODULE).node_ids
    bus = CanConfig(interface="xrl_unix", channel=str(folder / "can"))
    drive = OdriveCan(bus, nodes, recorded.robot.drive)
    stack.callback(drive.close)
    hub.poll()
    targets = [one.action.target for one in recorded.cycles if one.action.target is not None]
    inputs = itertools.cycle(targets)
    ids = [cansimple.arbitration_id(node, Command.GET_ENCODER_ESTIMATES) for node in nodes]

    def before() -> None:
        hub.poll()
        hub.broadcast([(can_id, cansimple.pack_two_floats(64.0, 0.1)) for can_id in ids])

    def once() -> None:
        drive.read(0.005)
        drive.write(next(inputs))

    return Repeated(once, before)


def _simulator_step(recorded: Recorded, _stack: ExitStack) -> Repeated:
    """Time one step of the world and its twelve emulated axes, without frames and bus."""
    world, bank = recorded.fleet.world, recorded.fleet.bank

    def once() -> None:
        world.step(bank.step(world.time, *world.motor_turns()))

    return Repeated(once)


def _recorder_chunk(recorded: Recorded, stack: ExitStack) -> Repeated:
    """Time writing `CHUNK` messages, compressed, to the file."""
    writer = _writer(recorded.robot, stack)
    outbox, messages = RecordedMessages(recorded.robot.name), itertools.cycle(recorded.messages)

    def before() -> None:
        for topic, module, message in itertools.islice(messages, CHUNK):
            outbox.put(topic, module, message)

    def once() -> None:
        writer.take_from(outbox, CHUNK)
        writer.flush()

    return Repeated(once, before)


def yardstick(_recorded: Recorded, _stack: ExitStack) -> Repeated:
    """Time `YARDSTICK_CALLS` solutions of a 12 x 12 system: a measure of the machine's speed."""
    A = np.eye(12) + 0.01 * np.arange(144.0).reshape(12, 12) / 144.0
    b = np.ones(12)

    def once() -> None:
        for _ in range(YARDSTICK_CALLS):
            np.linalg.solve(A, b)

    return Repeated(once)


Prepare = Callable[[Recorded, ExitStack], Repeated]


class Part(NamedTuple):
    """One row of the table."""

    name: str
    prepare: Prepare
    warm_us: float | None = None
    """Target of the median warm CPU time, us, or None."""
    cold_us: float | None = None
    """Target of the median cold CPU time, us, or None."""


PARTS: Final = (
    Part("planner tick", _planner_tick, warm_us=110.0, cold_us=300.0),
    Part("tick, the paper's split", functools.partial(_planner_tick, split="diagonal")),
    Part("joint cycle", _joint_cycle),
    Part("joint's drive over CAN", _drive_exchange),
    Part("simulator step", _simulator_step),
    Part(f"recorder, {CHUNK} messages", _recorder_chunk),
    Part("yardstick", yardstick),
)

LOCKSTEP: Final = {"lockstep": 10.0, "lockstep with a record": 7.0}
"""Targets of docs/results.md#targets, as multiples of real time."""
FIGURES: Final = (
    *(
        Figure(f"{part.name}, {how}", "us", target)
        for part in PARTS
        for how, target in (("warm", part.warm_us), ("cold", part.cold_us))
    ),
    *(Figure(name, "x", target) for name, target in LOCKSTEP.items()),
)


class Bench:
    """The timed parts of the fleet, prepared once for all turns."""

    def __init__(self, robot: RobotConfig, squat: Scenario, stack: ExitStack) -> None:
        """Run a squat in virtual time and prepare every part with its inputs."""
        recorded = record(robot, squat)
        self._parts = {part.name: part.prepare(recorded, stack) for part in PARTS}
        self._robot, self._squat = robot, squat
        self._writer = _writer(robot, stack)

    def turn(self) -> Turn:
        """Return each part's cost, us, and the speeds of lockstep as multiples of real time."""
        found: Turn = {
            name: _lockstep_speed(self._robot, self._squat, self._writer if record else None)
            for name, record in zip(LOCKSTEP, (False, True), strict=True)
        }
        for name, part in self._parts.items():
            for how, calls in CALLS.items():
                found[f"{name}, {how}"] = measure(part, calls, cold=how == "cold")
        return found


def _lockstep_speed(robot: RobotConfig, scenario: Scenario, writer: RunWriter | None) -> float:
    """Return how many times faster than real time one core runs the scenario's first `PIECE_S`.

    Standing up is not measured. With a writer the run is recorded.
    """
    outbox = RecordedMessages(robot.name)
    take = forget if writer is None else outbox.put
    fleet = Lockstep(robot, scenario, record=take, traced=writer is not None)
    begin_standing(fleet)
    begin, begin_ns = 0.0, 0
    for truth in fleet.run():
        if truth.scenario_s >= 0.0 and not begin_ns:
            begin, begin_ns = time.process_time(), fleet.now_ns
        if writer is not None and len(outbox) >= DRAIN_EVERY:
            writer.take_from(outbox, len(outbox))
        if truth.scenario_s >= PIECE_S:
            break
    return (fleet.now_ns - begin_ns) / NS_PER_S / (time.process_time() - begin)


def _writer(robot: RobotConfig, stack: ExitStack) -> RunWriter:
    """Open a log as the recorder does, but in a temporary folder."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="xrl-bench-")))
    return stack.enter_context(
        RunWriter(
            folder,
            topics.recorded_keys(robot.name),
            offset_ns=0,
            metadata={},
            attachments={},
            chunk_kib=robot.recorder.chunk_kib,
        )
    )
