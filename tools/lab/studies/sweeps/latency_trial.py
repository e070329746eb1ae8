"""One trial of the latency study: a squat led by hand under pushes, over a bad network.

The fleet starts and is led over a good network; at a random time every link is impaired, both ways,
to the end. That time, the pushes and the lost messages are random. They are the same for every
delay and control, and differ for each repeat, loss and jitter: a control's trials at one delay are
independent.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import JointEvent, JointState, Message, Mode, Pair, RunEvent, RunEventKind
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Keyframe, Scenario
from shared.joints import MODULES
from tools.lab.studies.sweeps import plants
from tools.lab.studies.sweeps.figures import (
    NOBODY,
    Ended,
    Ending,
    Observer,
    com_max_mm,
    ending_of,
    event_steps_nm,
    operator_peak_n,
    sole_tilt_max_rad,
    step_nm,
)
from tools.lab.studies.sweeps.push_range import SHARE, PushRange, uniform
from tools.lab.studies.sweeps.table import plain
from tools.sim.centralised import CentralisedLockstep
from tools.sim.lockstep import Lockstep
from tools.sim.virtual_services import Record

SQUATS: Final = ((0.5, 0.0), (3.0, 0.24), (5.5, 0.0), (8.0, 0.24))
"""s, and m below the stand: as in the paper's Fig. 7, at its pace."""
DURATION_S: Final = 7.0
IMPAIRED_FROM_S: Final = (0.1, 2.5)
"""On the first way down; the robot that holds from then on holds there."""
PUSH_SHARE: Final = (0.2, SHARE)
PUSH_S: Final = 0.3
PUSHES: Final = 3
PUSHED_UNTIL_S: Final = 5.3
"""The pushes come over the bad network, one in each third of the time, at random."""


class ControlKind(msgspec.Struct, frozen=True):
    """One way to control the robot."""

    about: str
    fleet: type[Lockstep]
    split: str | None = None
    """`law.split`; None: as the robot file has it."""


CONTROLS: Final = {
    "distributed": ControlKind(
        "as shipped: local gains certified, the rest by the planner", Lockstep
    ),
    "diagonal": ControlKind("the paper's local gains, diag(K_q)", Lockstep, "diagonal"),
    "centralised": ControlKind(
        "every torque by the planner, and nothing below it: gains not retuned for the delay, no "
        "damping on the drives, the last torques kept when no new ones come, overload ignored",
        CentralisedLockstep,
    ),
}
"""By name."""


class Network(msgspec.Struct, frozen=True):
    """What every link does, each way, once it is bad. Datagrams: nothing waits."""

    delay_ms: float
    jitter_ms: float
    """Uniform, +- so much."""
    loss: float
    """Share of the messages."""


class Shove(NamedTuple):
    """A push that is drawn."""

    at: float
    """s"""
    share: float
    """1 is what soles and motors bear along its direction (`PushRange`)."""
    angle: float
    """rad from x (forwards) to y (left)."""


class Draw(msgspec.Struct, frozen=True):
    """Random draws of a trial."""

    impaired_from_s: float
    shoves: tuple[Shove, ...]
    fleet_seed: int
    """Seed of losses, jitter and the harness sensor's noise."""


class LatencyTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A trial."""

    number: int
    """Number of the row."""
    repeat: int
    seed: int
    control: str
    network: Network

    @property
    def draw(self) -> Draw:
        """Random draws, the same for every delay and control."""
        jitter, loss = plain(self.network.jitter_ms), plain(self.network.loss)
        dice = random.Random(f"latency {self.seed} {self.repeat} {jitter} {loss}")
        begin = uniform(dice, *IMPAIRED_FROM_S)
        third = (PUSHED_UNTIL_S - begin) / PUSHES
        shoves = []
        for index in range(PUSHES):
            at = begin + index * third + dice.uniform(0.0, third - PUSH_S)
            shoves.append(Shove(at, dice.uniform(*PUSH_SHARE), dice.uniform(-math.pi, math.pi)))
        return Draw(begin, tuple(shoves), dice.getrandbits(48))

    def scenario(self, robot: RobotConfig) -> Scenario:
        """Return the trial as a scenario."""
        stand = robot.simulation.stand_height
        draw, pushes = self.draw, PushRange(robot)
        fields = msgspec.structs.asdict(self.network)
        bad = Inject(link="all", at=draw.impaired_from_s, **fields)
        return Scenario(
            name=f"latency-{self.seed}-{self.number}",
            about=f"trial {self.number} of `xrl study latency --seed {self.seed}`",
            duration=DURATION_S,
            keyframe=tuple(Keyframe(at=at, height=stand - depth) for at, depth in SQUATS),
            push=tuple(pushes.push(at, PUSH_S, *how) for at, *how in draw.shoves),
            inject=(bad,) if any(fields.values()) else (),
        )


class LatencyResult(Ended, frozen=True, kw_only=True):
    """The figures of a trial, over the bad network, to the end or the fall."""

    operator_peak_n: float | None = None
    """Vertical force of the hand."""
    operator_rms_n: float | None = None
    com_max_mm: float | None = None
    """Largest horizontal distance of the COM from the middle of the ankles."""
    hold_share: float | None = None
    """Fraction of the time in which a module held, so that the robot did not follow the hand.

    Always 0 for the centralised control, which has no HOLD.
    """
    holds: int | None = None
    """Changes from TRACK to HOLD of the busiest module."""
    torque_step_nm: float | None = None
    """Largest change of a joint's torque from one state to the next (4 ms)."""
    hold_step_nm: float | None = None
    """Largest step of a joint's torque into or out of HOLD, from one cycle to the next."""
    sole_tilt_max_rad: float | None = None


def row_of(trial: LatencyTrial) -> dict[str, object]:
    """Return a trial by column; the network as its flags have it, to the last digit."""
    network = msgspec.structs.asdict(trial.network)
    return {
        "number": trial.number,
        "repeat": trial.repeat,
        "control": trial.control,
        **{name: plain(value) for name, value in network.items()},
        "impaired_from_s": trial.draw.impaired_from_s,
    }


def robot_of(robot: RobotConfig, control: str) -> RobotConfig:
    """Return the robot with the gain split of a control."""
    split = CONTROLS[control].split
    if split is None:
        return robot
    return msgspec.structs.replace(robot, law=msgspec.structs.replace(robot.law, split=split))


class LatencyRecorder:
    """Collects from the messages what the figures need, and passes all of them on."""

    def __init__(self, on_to: Record, impaired_from_s: float) -> None:
        self._on_to = on_to
        self._tau: dict[str, Pair] = {}
        self._after_ns = round(impaired_from_s * NS_PER_S)
        self.from_ns: int | None = None
        """Time at which the network is impaired; None before the scenario has started."""
        self.fallen = False
        """From then on nothing counts."""
        self.torque_step = 0.0
        """As `LatencyResult.torque_step_nm`."""

    def __call__(self, topic: Topic, module: str, message: Message) -> None:
        """Take a message as the bus would."""
        if isinstance(message, JointState):
            if self.from_ns is not None and message.t_ns >= self.from_ns and not self.fallen:
                step = step_nm(self._tau[module], message.tau)
                self.torque_step = max(self.torque_step, step)
            self._tau[module] = message.tau
        elif isinstance(message, RunEvent) and message.kind == RunEventKind.STARTED:
            self.from_ns = message.t_ns + self._after_ns
        self._on_to(topic, module, message)


def fleet_of(trial: LatencyTrial, robot: RobotConfig, record: Record) -> Lockstep:
    """Return the fleet of a trial, before its first step."""
    return CONTROLS[trial.control].fleet(
        robot,
        trial.scenario(robot),
        Impairment(),
        seed=trial.draw.fleet_seed,
        record=record,
        plant=plant_of(trial),
    )


def plant_of(trial: LatencyTrial) -> PlantConfig:
    """Return the trial's true robot: all errors drawn, the same for each control."""
    return plants.draw(f"latency {trial.draw.fleet_seed}")


def run_trial(
    trial: LatencyTrial, robot: RobotConfig, observer: Observer = NOBODY
) -> LatencyResult:
    """Run a trial to its end or to the fall, and measure it."""
    impaired_from_s = trial.draw.impaired_from_s
    monitor = LatencyRecorder(observer.record, impaired_from_s)
    fleet = fleet_of(trial, robot, monitor)
    rows: list[SimTruth] = []
    for row in observer.rows_that_count(fleet.run(), impaired_from_s):
        rows.append(row)
        monitor.fallen = row.fallen
    return measure(rows, fleet.events, monitor, robot)


def measure(
    rows: Sequence[SimTruth],
    events: Sequence[tuple[str, JointEvent]],
    monitor: LatencyRecorder,
    robot: RobotConfig,
) -> LatencyResult:
    """Return the figures of a run, by the world since the impairment began and all messages."""
    if not rows or monitor.from_ns is None:
        return LatencyResult(ending=Ending.FELL if rows else Ending.UNREADY)
    last = rows[-1]
    hand = np.array([row.operator_force[2] for row in rows])
    within = [(m, e) for m, e in events if monitor.from_ns <= e.t_ns <= last.t_ns]
    since = [(m, e) for m, e in within if e.mode_after in (Mode.HOLD, Mode.TRACK)]
    into_hold = [m for m, e in since if e.mode_after == Mode.HOLD]
    return LatencyResult(
        ending=ending_of(last, DURATION_S, robot),
        fell_at_s=last.scenario_s if last.fallen else None,
        operator_peak_n=operator_peak_n(rows),
        operator_rms_n=float(np.sqrt(np.mean(hand * hand))),
        com_max_mm=com_max_mm(rows),
        hold_share=hold_share(events, monitor.from_ns, last.t_ns),
        holds=max(into_hold.count(module) for module in MODULES),
        torque_step_nm=monitor.torque_step,
        hold_step_nm=max(event_steps_nm(event for _, event in since), default=0.0),
        sole_tilt_max_rad=sole_tilt_max_rad(rows),
    )


def hold_share(events: Sequence[tuple[str, JointEvent]], from_ns: int, to_ns: int) -> float:
    """Return the share of a time in which a module held, by all changes since the start."""
    if to_ns <= from_ns:
        return 0.0
    holding: set[str] = set()
    held_ns, since_ns = 0, from_ns
    for module, event in sorted(events, key=lambda row: row[1].t_ns):
        now_ns = min(max(event.t_ns, from_ns), to_ns)
        if holding:
            held_ns += now_ns - since_ns
        since_ns = now_ns
        if event.mode_after == Mode.HOLD:
            holding.add(module)
        else:
            holding.discard(module)
    if holding:
        held_ns += to_ns - since_ns
    return held_ns / (to_ns - from_ns)
