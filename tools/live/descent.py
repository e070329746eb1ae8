"""The robot's way down, and the wait for its weight to be taken, before its drives go limp.

The robot stands on feet under shins of a metre. Idled in its lowest pose it tips over as it does
from a stand: the torso meets the floor at 2.8 to 3.1 m/s either way. So going down ends with a
robot that still holds, and the drives idle once something else bears it: a hoist, or a stand.

`Descent` is the law of it, without bus or clock. Does the robot bear weight? The joints' torques
tell; what is not known counts as weight.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from enum import Enum
from pathlib import Path
from typing import Final

import numpy as np

from services.planner.law.kinematics import Measured
from shared.bus import topics
from shared.bus.credentials import require_operator
from shared.bus.messages import (
    DriveStatus,
    Estop,
    JointState,
    Mode,
    OperatorIntent,
    PlannerMode,
    PlannerStatus,
    name_of,
)
from shared.bus.session import Session, open_session
from shared.clock import now_ns
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.config.scenarios import SCENARIO
from shared.exceptions import BusError, FleetError
from shared.joints import MODULE_INDEX, MODULES, SIDES
from shared.places import user_name

WAYS: Final = (
    "hang the robot, or put a stand under its torso, and `xrl down` again; or, to let it drop, "
    "`xrl down --limp`"
)
LIGHT_FRACTION: Final = 0.25
"""Fraction of the torso's weight by the file; with less on its legs the robot hangs. Without its
payload half of it is left."""
LIGHT_S: Final = 1.0
"""Time for which it must be so: a robot that bounces is light for a moment."""
HEARD_S: Final = 3.0
"""Longest wait for the first states of all six modules, s."""
PATIENCE_S: Final = 8.0
"""Longest wait for a planner that may lead again, s."""
STALLED_S: Final = 4.0
STALLED_M: Final = 0.005
"""Sunk by less than this in that time, something holds the robot up."""
SETTLE_S: Final = 40.0
"""Longest time for DAMP to come to rest, s."""
REST_S: Final = 1.0
REST_RAD: Final = 0.01
"""A knee that moves less than this in that time is at rest; rates are too noisy to tell."""
STRAIGHT: Final = -1.0
"""rad of a knee; above it, a leg whose load is unknown is straight, not folded."""
PULLED: Final = 3.0
"""N m; a straight leg's torques do not show what it bears. Weight presses a knee back, so one that
its own shin pulls against the stop harder than friction can bears nothing."""
KNEE_CLOSE: Final = 0.08
"""rad above the stop at which a knee is down: play and friction keep it there."""
_KNEES: Final = tuple(MODULE_INDEX[f"knee_{side}"] for side in SIDES)
_NO_TORQUE: Final = (DriveStatus.IDLE, DriveStatus.ERROR, DriveStatus.UNZEROED)
_MAY_LEAD: Final = (
    PlannerMode.LEADING, PlannerMode.ALIGNING, PlannerMode.TRIPPED, PlannerMode.OVERLOADED,
)  # fmt: skip
"""Modes of a planner that leads, or will once it is calm."""


class Ask(Enum):
    """What the robot is asked for after a look."""

    NOTHING = 0
    SIT = 1
    """The planner: go down."""
    STOP = 2
    """The modules: DAMP."""
    IDLE = 3
    """Nothing bears weight: the drives may go limp."""


class DescentPhase(Enum):
    """How far it is."""

    LOOKING = "looking whether it bears weight"
    LOWERING = "going down, led by the planner"
    SETTLING = "sinking in DAMP"
    RESTING = "holds at its lowest pose"


class _LegLoad:
    """How much of the torso's weight the legs bear, by the joints' torques."""

    def __init__(self, robot: RobotConfig) -> None:
        """Take masses and geometry."""
        self._measured = Measured(robot)
        self._weight = GRAVITY * robot.torso_mass
        self.com_height = math.nan
        """Height of the COM at the last look, m above the ankles."""

    def fraction(self, states: Sequence[JointState | None]) -> float:
        """Return the legs' upward force over the torso's weight; NaN if it is not known."""
        known = [state for state in states if state is not None]
        if len(known) < len(MODULES):
            return math.nan
        q, v, tau = (
            np.array([getattr(state, name) for state in known]).ravel()
            for name in ("q", "v", "tau")
        )
        self._measured.update(q, v)
        self.com_height = float(self._measured.p[2])
        if all(_has_no_torque(state) for state in known):
            return 0.0
        if any(state.mode not in (Mode.HOLD, Mode.TRACK, Mode.DAMP) for state in known):
            return math.nan  # limp, lost, or held by a drive that nobody asks
        loads = [
            0.0 if math.isnan(load) and knee.q[1] > STRAIGHT and knee.tau[1] < -PULLED else load
            for load, knee in zip(
                self._measured.leg_loads(tau), (known[i] for i in _KNEES), strict=True
            )
        ]
        return sum(loads) / self._weight


def _has_no_torque(state: JointState) -> bool:
    return state.mode in (Mode.DISARMED, Mode.FAULT) and state.drive in _NO_TORQUE


class Descent:
    """Decides at each look what to ask for."""

    def __init__(self, robot: RobotConfig, wait_s: float) -> None:
        """Begin with a look; at rest wait `wait_s` for the weight to be taken."""
        self._load, self._wait_s = _LegLoad(robot), wait_s
        self._stop = robot.joint_service.damp_knee_stop
        self._fade_s = robot.joint_service.damp_fade_s
        self.phase = DescentPhase.LOOKING
        self._since_s: float | None = None
        self._light_s: float | None = None
        self._moved_s = 0.0
        self._height = self._rested = math.inf
        self._led_s = 0.0
        self._fraction = math.nan
        self._knee = math.nan

    @property
    def words(self) -> str:
        """The present state as a line."""
        at = f"COM {self._load.com_height:.2f} m above the ankles, knees at {self._knee:.2f} rad"
        return f"{self.phase.value}: {at}, {self._bears}"

    @property
    def _bears(self) -> str:
        if math.isnan(self._fraction):
            return "weight unknown"
        return f"the legs bear {100.0 * self._fraction:.0f} % of the torso"

    def step(
        self, now_s: float, states: Sequence[JointState | None], status: PlannerStatus | None
    ) -> Ask:
        """Look once, by any clock; None: not heard just now.

        Raises:
            FleetError: it cannot go on; the robot is left as it stands.
        """
        if self._since_s is None:
            self._since_s = now_s
        self._fraction = self._load.fraction(states)
        light = self._fraction < LIGHT_FRACTION  # NaN is not
        self._light_s = (self._light_s if self._light_s is not None else now_s) if light else None
        if self._light_s is not None and now_s - self._light_s >= LIGHT_S:
            return Ask.IDLE
        known = [state for state in states if state is not None]
        if len(known) == len(MODULES):
            self._knee = min(known[knee].q[1] for knee in _KNEES)
        match self.phase:
            case DescentPhase.LOOKING:
                return self._look(now_s, states, status)
            case DescentPhase.LOWERING:
                return self._lower(now_s, known, status)
            case DescentPhase.SETTLING:
                return self._settle(now_s, known)
            case DescentPhase.RESTING:
                return self._rest(now_s)

    def _enter(self, phase: DescentPhase, now_s: float) -> None:
        self.phase, self._since_s = phase, now_s
        self._moved_s = self._led_s = now_s
        self._height = self._rested = math.inf

    def _for_s(self, now_s: float) -> float:
        return now_s - (self._since_s or 0.0)

    def _look(
        self, now_s: float, states: Sequence[JointState | None], status: PlannerStatus | None
    ) -> Ask:
        silent = [name for name, state in zip(MODULES, states, strict=True) if state is None]
        if silent:
            if self._for_s(now_s) > HEARD_S:
                raise FleetError(f"{', '.join(silent)}: not heard, so it may bear weight: {WAYS}")
            return Ask.NOTHING
        if self._for_s(now_s) < LIGHT_S or self._light_s is not None:
            return Ask.NOTHING
        limp = [
            f"{name} {name_of(Mode, state.mode)}"
            for name, state in zip(MODULES, states, strict=True)
            if state is not None and state.mode in (Mode.DISARMED, Mode.FAULT)
        ]
        if limp:
            raise FleetError(
                f"{', '.join(limp)}: it may bear weight on the others, and going down would tip "
                f"it: {WAYS}"
            )
        damped = all(state is not None and state.mode == Mode.DAMP for state in states)
        may_lead = status is not None and status.mode in _MAY_LEAD
        self._enter(
            DescentPhase.LOWERING if may_lead and not damped else DescentPhase.SETTLING, now_s
        )
        return Ask.NOTHING

    def _lower(
        self, now_s: float, known: Sequence[JointState], status: PlannerStatus | None
    ) -> Ask:
        if status is not None and status.mode == PlannerMode.LEADING:
            self._led_s = now_s
        elif now_s - self._led_s > (HEARD_S if status is None else PATIENCE_S):
            if status is None:  # dead, or cut off: DAMP needs no planner
                self._enter(DescentPhase.SETTLING, now_s)
                return Ask.STOP
            why = status.why or name_of(PlannerMode, status.mode)
            raise FleetError(
                f"the planner does not lead ({why}), so it stands where it is; `xrl estop` lets "
                f"it sink without a planner; or {WAYS}"
            )
        if len(known) < len(MODULES):
            return Ask.SIT
        height = self._load.com_height
        if height < self._height - STALLED_M or self._led_s != now_s:
            self._height, self._moved_s = min(height, self._height), now_s
        if self._knee < self._stop + KNEE_CLOSE and now_s - self._moved_s > REST_S:
            self._enter(DescentPhase.SETTLING, now_s)
            return Ask.STOP
        if now_s - self._moved_s > STALLED_S:
            raise FleetError(
                f"it is held up at a COM of {height:.2f} m, so it stands where it is: take the "
                "hand off and `xrl down` again; where a stand bears it, `xrl estop` lets it settle"
            )
        return Ask.SIT

    def _settle(self, now_s: float, known: Sequence[JointState]) -> Ask:
        if any(state.mode not in (Mode.DAMP, Mode.FAULT) for state in known):
            self._moved_s = now_s
            if self._for_s(now_s) > HEARD_S:
                raise FleetError(f"not all modules go to DAMP: see `xrl status`; {WAYS}")
            return Ask.STOP
        if len(known) < len(MODULES) or abs(self._knee - self._rested) > REST_RAD:
            self._moved_s, self._rested = now_s, self._knee
        if self._for_s(now_s) > self._fade_s and now_s - self._moved_s > REST_S:
            self._enter(DescentPhase.RESTING, now_s)
        elif self._for_s(now_s) > SETTLE_S:
            raise FleetError(f"it does not come to rest within {SETTLE_S:g} s; {WAYS}")
        return Ask.NOTHING

    def _rest(self, now_s: float) -> Ask:
        if self._for_s(now_s) > self._wait_s:
            raise FleetError(
                f"down, and it still holds: {self._bears}; its services go on, and nothing is "
                f"limp: {WAYS}"
            )
        return Ask.NOTHING


LOOK_S: Final = 0.02
"""An intent that is not repeated ends within `assist.stale_ms`."""
UNHEARD_S: Final = 0.5
"""A state or a status that is older is not heard."""
TELL_S: Final = 1.0
WAITING_TELL_S: Final = 5.0

HINT: Final = "; take its weight: hang it, feet in the air, or put a stand under its torso"

Tell = Callable[[str], None]


def asker(verb: str) -> str:
    """Return the requester's name for a verb, as `OperatorIntent.source` has it."""
    return f"xrl {verb} by {user_name()} ({os.getpid()})"


def other_asker(status: PlannerStatus | None, own: str = "") -> str:
    """Return who else requests something of the planner; "" if only a scenario or nobody does."""
    by = "" if status is None else status.requested_by
    return "" if by in (SCENARIO, own) else by


def lower(robot: RobotConfig, run_dir: Path, tell: Tell, *, wait_s: float, simulated: bool) -> None:
    """Go down, and wait until nothing bears on the legs; at once if nothing does.

    Ctrl-C ends it: until it is down the robot stands where it is. Its weight is to be taken within
    `wait_s`; of a simulated one it is enough that it is down.

    Raises:
        FleetError: it bears weight and cannot go down, or nothing takes its weight.
    """
    try:
        with open_session(robot, "down", run_dir) as session:
            _Lowering(robot, session, tell, simulated=simulated).run(Descent(robot, wait_s))
    except BusError as error:
        raise FleetError(f"{error}; so nobody knows whether it bears weight: {WAYS}") from None


class _Lowering:
    """One way down."""

    def __init__(
        self, robot: RobotConfig, session: Session, tell: Tell, *, simulated: bool
    ) -> None:
        self._robot, self._tell, self._simulated = robot, tell, simulated
        states = [session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES]
        statuses = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        self._takes: list[Callable[[], JointState | PlannerStatus | None]] = [
            *(latest.take for latest in states),
            statuses.take,
        ]
        self._intents = session.publisher(topics.OPERATOR_INTENT, OperatorIntent)
        self._stops = session.publisher(topics.ESTOP, Estop)
        self._source = asker("down")
        self._assist_n = 0.0
        self._seq = 0

    def run(self, descent: Descent) -> None:
        """Look, ask and tell until it is over."""
        heard: list[tuple[float, JointState | PlannerStatus | None]] = [(0.0, None)] * 7
        told_s, phase, ask = 0.0, descent.phase, Ask.NOTHING
        try:
            while True:
                now_s = time.monotonic()
                for index, take in enumerate(self._takes):
                    message = take()
                    if message is not None:
                        heard[index] = now_s, message
                newest = [row if now_s - at_s < UNHEARD_S else None for at_s, row in heard]
                states = [row if isinstance(row, JointState) else None for row in newest[:-1]]
                status = newest[-1] if isinstance(newest[-1], PlannerStatus) else None
                ask = descent.step(now_s, states, status)
                self._ask(ask, descent.phase, status)
                pause_s = WAITING_TELL_S if descent.phase is DescentPhase.RESTING else TELL_S
                if descent.phase is not phase or (
                    now_s - told_s > pause_s and phase is not DescentPhase.LOOKING
                ):
                    told_s, phase = now_s, descent.phase
                    waits = phase is DescentPhase.RESTING and not self._simulated
                    self._tell(descent.words + (HINT if waits else ""))
                if ask is Ask.IDLE or (self._simulated and descent.phase is DescentPhase.RESTING):
                    return
                time.sleep(LOOK_S)
        except KeyboardInterrupt:
            self._tell(
                "interrupted: its services go on, and "
                + (
                    "it stands where it is"
                    if descent.phase in (DescentPhase.LOOKING, DescentPhase.LOWERING)
                    else "it sinks to its lowest pose in DAMP, where it holds"
                )
            )
            raise
        finally:
            if descent.phase is not DescentPhase.LOOKING:
                self._put_intent(sit=False)

    def _ask(self, ask: Ask, phase: DescentPhase, status: PlannerStatus | None) -> None:
        """Repeat what is asked for; a simulated person keeps the hand off until it is down."""
        if ask in (Ask.SIT, Ask.STOP) and not self._seq:
            require_operator(self._robot, "down")
            if other := other_asker(status, self._source):
                raise FleetError(f"{other} asks the robot for something else; end that first")
            # the person who is carried is carried on
            self._assist_n = status.assist_requested_n if status is not None else 0.0
        if ask is Ask.STOP:
            self._stops.put(Estop(t_ns=now_ns(), seq=self._seq, source=self._source))
        if phase is not DescentPhase.LOOKING:
            self._put_intent(sit=True)

    def _put_intent(self, *, sit: bool) -> None:
        self._seq += 1
        self._intents.put(
            OperatorIntent(
                t_ns=now_ns(),
                seq=self._seq,
                assist_n=self._assist_n,
                source=self._source,
                sit=sit,
            )
        )
