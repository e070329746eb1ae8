"""Runs in virtual time, recorded into `run.mcap`."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, TypeVar

from services.planner.controller import ATTACHED, controller_maker, split_spec
from services.simulator.physics.plant import PlantConfig
from shared import revision
from shared.bus import topics
from shared.bus.codec import encode
from shared.bus.messages import Message
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.mcap_log import provenance
from shared.mcap_log.writer import SCHEMA_VERSION, RunWriter
from shared.robot.robot_model import mjcf
from tools.live import experiment
from tools.logs.hand_path import HandRow
from tools.sim.centralised import CONTROLS, SHIPPED
from tools.sim.lockstep import Watch
from tools.sim.virtual_services import Record

Outcome = TypeVar("Outcome")
AFTER_FALL_S: Final = 1.0
"""Time for which a recorded run continues after a fall, s, so that the log shows it."""
DRAIN_EVERY: Final = 512
"""Number of waiting messages at which all of them are written to the log."""


class RecordedMessages:
    """Queue of messages for the log."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._queue: deque[tuple[str, bytes, int]] = deque()
        self._newest_ns = 0

    def __len__(self) -> int:
        """Return the number of waiting messages."""
        return len(self._queue)

    def put(self, topic: Topic, module: str, message: Message) -> None:
        """Queue a message of a recorded topic as the bus would.

        Arrival times never decrease, although a joint service with a silent drive stamps its states
        with the time of the last sample.
        """
        if not topic.recorded:
            return
        self._newest_ns = max(self._newest_ns, message.t_ns)
        self._queue.append((topic.key(self._robot, module), encode(message), self._newest_ns))

    def take(self) -> tuple[str, bytes, int] | None:
        """Return the oldest message, or None."""
        return self._queue.popleft() if self._queue else None


def record_run(
    scenario: Scenario,
    robot: RobotConfig,
    out: Path,
    metadata: dict[str, str],
    run: Callable[[Record, Watch], Outcome],
    watch: Watch,
    true_plant: PlantConfig,
    attached: Sequence[tuple[str, Path]] = (),
) -> Outcome:
    """Record one run into `run.mcap` with its inputs beside it, and return what `run` returned.

    `run` must simulate `true_plant`. It receives two functions: one records a message, the other
    receives the truth. `metadata` is added to the log's metadata. Its key `lockstep` must
    describe the command or the network. The files `attached` are attached to the log.

    Raises:
        RunError: the log cannot be written.
    """
    inputs = experiment.write_inputs(out, robot, scenario, true_plant)
    messages = RecordedMessages(robot.name)
    recorded = topics.recorded_keys(robot.name)
    run_metadata = {
        "schema_version": SCHEMA_VERSION,
        "robot": robot.name,
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "scenario": scenario.name,
    }
    with RunWriter(
        out,
        recorded,
        offset_ns=0,
        metadata={
            "run": run_metadata | metadata | revision.code() | provenance.machine(),
            "packages": provenance.packages(),
        },
        attachments={file.name: file.read_bytes() for file in inputs}
        | {"model.xml": mjcf(robot).encode()}
        | {name: file.read_bytes() for name, file in attached},
        chunk_kib=robot.recorder.chunk_kib,
    ) as writer:

        def drain(truth: SimTruth) -> None:
            if len(messages) >= DRAIN_EVERY:
                writer.take_from(messages, len(messages))
            watch(truth)

        outcome = run(messages.put, drain)
        writer.take_from(messages, len(messages))
    return outcome


def simulate(
    robot: RobotConfig,
    scenario: Scenario,
    network: Impairment,
    seed: int,
    out: Path,
    watch: Watch = lambda _truth: None,
    control: str = SHIPPED,
    true_plant: PlantConfig | None = None,
    hand: Sequence[HandRow] = (),
    controller: str | None = None,
) -> float:
    """Record a run of the fleet in virtual time, to its end or one second past a fall.

    Returns the simulated time, s. `network` applies to every link, in addition to the scenario's
    impairments; `seed` is for the sensors' noise and the network. `control` is a key of `CONTROLS`;
    `hand` leads in place of the scenario; `controller`, `FILE.py[:NAME]`, replaces the law.

    Raises:
        RunError: the log cannot be written.
        ConfigError: the controller cannot be used.
    """
    true_plant = true_plant or PlantConfig()
    make = controller_maker(controller, robot) if controller is not None else None
    attached = [(ATTACHED, split_spec(controller)[0])] if controller is not None else []

    def run(record: Record, drain: Watch) -> float:
        inputs: dict[str, Any] = {
            "seed": seed, "record": record, "plant": true_plant, "hand": hand,
        }  # fmt: skip
        if make is not None:
            inputs["controller"] = make
        if control == SHIPPED:  # as `xrl demo` runs it, all on one host
            inputs |= {"planner_beside": True, "traced": True}
        fleet = CONTROLS[control](robot, scenario, network, **inputs)
        end_s = math.inf
        for truth in fleet.run():
            drain(truth)
            if truth.fallen:
                end_s = min(end_s, truth.scenario_s + AFTER_FALL_S)
            if truth.scenario_s > end_s:
                break
        fleet.network.end(fleet.now_ns)
        return fleet.now_ns / NS_PER_S

    lockstep = (
        f"delay {network.delay_ms:g} ms, jitter {network.jitter_ms:g} ms, "
        f"loss {network.loss:g}, seed {seed}"
    )
    metadata = {"lockstep": lockstep, "control": control}
    if controller is not None:
        metadata["controller"] = controller
    return record_run(scenario, robot, out, metadata, run, watch, true_plant, attached)
