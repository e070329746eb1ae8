"""Descent of the robot, and the wait until a hoist takes its weight, before its drives go limp.

Idling the drives in the lowest pose would not be gentle: the shins are a metre long, so the robot
tips over as from a stand, and the torso hits the floor at 2.8 to 3.1 m/s either way. So the robot
holds at the end of the descent, and its drives idle only after a hoist or a stand carries it.

`Descent` makes the decisions, without bus or clock. The joints' torques show whether the robot
stands on its legs; an unknown load counts as weight.
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
    "hang the robot, or put a stand under its torso, and run `xrl down` again; or run "
    "`xrl down --limp` to let it drop"
)
LIGHT_FRACTION: Final = 0.25
"""With less than this fraction of the torso's weight on its legs, the robot hangs. Without the
payload, the torso keeps half of its weight."""
LIGHT_S: Final = 1.0
"""Time for which the load must stay that low, s: a bouncing robot is light for a moment."""
HEARD_S: Final = 3.0
"""Timeout for the first states of all six modules, s."""
PATIENCE_S: Final = 8.0
"""Timeout for a planner that may lead again, s."""
STALLED_S: Final = 4.0
STALLED_M: Final = 0.005
"""If the robot sinks by less than `STALLED_M` in `STALLED_S`, something holds it up."""
SETTLE_S: Final = 40.0
"""Timeout for the robot to come to rest in DAMP, s."""
REST_S: Final = 1.0
REST_RAD: Final = 0.01
"""A knee that moves less than this in `REST_S` is at rest; its rate is too noisy to show it."""
STRAIGHT: Final = -1.0
"""Knee angle, rad; above it a leg with unknown load is straight, not folded."""
PULLED: Final = 3.0
"""N m. A straight leg's torques do not show its load. But the leg carries nothing if its knee
torque is below minus this: then the hanging shin, not friction, pulls the knee to its stop."""
KNEE_CLOSE: Final = 0.08
"""A knee this close to its stop, rad, is down: play and friction keep it from reaching the stop."""
_KNEES: Final = tuple(MODULE_INDEX[f"knee_{side}"] for side in SIDES)
_NO_TORQUE: Final = (DriveStatus.IDLE, DriveStatus.ERROR, DriveStatus.UNZEROED)
_MAY_LEAD: Final = (
    PlannerMode.LEADING, PlannerMode.ALIGNING, PlannerMode.TRIPPED, PlannerMode.OVERLOADED,
)  # fmt: skip
"""Modes of a planner that leads, or will lead when the motion is calm."""


class Ask(Enum):
    """Request to the robot after a step."""

    NOTHING = 0
    SIT = 1
    """The planner must lower the robot."""
    STOP = 2
    """The modules must enter DAMP."""
    IDLE = 3
    """The legs carry no weight: the drives may go limp."""


class DescentPhase(Enum):
    """Progress of the descent."""

    LOOKING = "checking whether the legs carry the robot"
    LOWERING = "going down, led by the planner"
    SETTLING = "sinking in DAMP"
    RESTING = "holding at its lowest pose"


class _LegLoad:
    """Fraction of the torso's weight on the legs, from the joints' torques."""

    def __init__(self, robot: RobotConfig) -> None:
        """Use the robot's masses and geometry."""
        self._measured = Measured(robot)
        self._weight = GRAVITY * robot.torso_mass
        self.com_height = math.nan
        """Height of the COM at the last call, m above the ankles."""

    def fraction(self, states: Sequence[JointState | None]) -> float:
        """Return the legs' upward force over the torso's weight; NaN if unknown."""
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
            return math.nan  # limp, lost, or held by a drive without a service
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
    """Decides at each step what to request."""

    def __init__(self, robot: RobotConfig, wait_s: float) -> None:
        """Begin by checking the load; `wait_s` is the timeout for a hoist or stand to take it."""
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
        """The present state in one line."""
        at = f"COM {self._load.com_height:.2f} m above the ankles, knees at {self._knee:.2f} rad"
        return f"{self.phase.value}: {at}, {self._bears}"

    @property
    def _bears(self) -> str:
        if math.isnan(self._fraction):
            return "the load of the legs is unknown"
        return f"the legs carry {100.0 * self._fraction:.0f} % of the torso's weight"

    def step(
        self, now_s: float, states: Sequence[JointState | None], status: PlannerStatus | None
    ) -> Ask:
        """Run one step, with any clock; a state or status is None if it is stale.

        Raises:
            FleetError: the descent cannot continue; the robot is left as it stands.
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
                raise FleetError(
                    f"{', '.join(silent)}: silent, so the robot may still stand on its legs; {WAYS}"
                )
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
                f"{', '.join(limp)}: the legs may still carry the robot, and going down would "
                f"tip the robot; {WAYS}"
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
                f"the planner does not lead ({why}), so the robot stands where it is; run "
                f"`xrl estop`, which lets it sink without a planner; or {WAYS}"
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
                f"the robot is held up at a COM height of {height:.2f} m, so it stands there; take "
                "the hand off and run `xrl down` again; if a stand carries it, run `xrl estop`"
            )
        return Ask.SIT

    def _settle(self, now_s: float, known: Sequence[JointState]) -> Ask:
        if any(state.mode not in (Mode.DAMP, Mode.FAULT) for state in known):
            self._moved_s = now_s
            if self._for_s(now_s) > HEARD_S:
                raise FleetError(
                    f"not all modules go to DAMP; `xrl status` shows their modes; {WAYS}"
                )
            return Ask.STOP
        if len(known) < len(MODULES) or abs(self._knee - self._rested) > REST_RAD:
            self._moved_s, self._rested = now_s, self._knee
        if self._for_s(now_s) > self._fade_s and now_s - self._moved_s > REST_S:
            self._enter(DescentPhase.RESTING, now_s)
        elif self._for_s(now_s) > SETTLE_S:
            raise FleetError(f"the robot does not come to rest within {SETTLE_S:g} s; {WAYS}")
        return Ask.NOTHING

    def _rest(self, now_s: float) -> Ask:
        if self._for_s(now_s) > self._wait_s:
            raise FleetError(
                f"down, but the legs may still carry the robot: {self._bears}; its services "
                f"continue, and the drives stay armed; {WAYS}"
            )
        return Ask.NOTHING


LOOK_S: Final = 0.02
"""Period of a step, s. An intent that is not repeated ends within `assist.stale_ms`."""
UNHEARD_S: Final = 0.5
"""Age from which a state or a status is stale, s."""
TELL_S: Final = 1.0
WAITING_TELL_S: Final = 5.0

HINT: Final = (
    "; take the robot's weight: hang it with its feet in the air, or put a stand under its torso"
)

Tell = Callable[[str], None]


def asker(verb: str) -> str:
    """Return the requester's name for a verb, as in `OperatorIntent.source`."""
    return f"xrl {verb} by {user_name()} ({os.getpid()})"


def other_asker(status: PlannerStatus | None, own: str = "") -> str:
    """Return the name of another tool whose request the planner follows, or an empty string."""
    by = "" if status is None else status.requested_by
    return "" if by in (SCENARIO, own) else by


def lower(robot: RobotConfig, run_dir: Path, tell: Tell, *, wait_s: float, simulated: bool) -> None:
    """Lower the robot, and wait until its legs carry no weight; return at once if it hangs.

    After Ctrl-C the robot stands where it is, or continues to sink if it is already in DAMP. Its
    weight must be taken within `wait_s`; a simulated robot only needs to be down.

    Raises:
        FleetError: the robot stands and cannot be lowered, or nothing takes its weight.
    """
    try:
        with open_session(robot, "down", run_dir) as session:
            _Lowering(robot, session, tell, simulated=simulated).run(Descent(robot, wait_s))
    except BusError as error:
        raise FleetError(
            f"{error}; it is unknown whether the legs carry the robot; {WAYS}"
        ) from None


class _Lowering:
    """One descent."""

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
        """Receive, step, request and report until the descent is over."""
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
                "interrupted: the services continue, and "
                + (
                    "the robot stands where it is"
                    if descent.phase in (DescentPhase.LOOKING, DescentPhase.LOWERING)
                    else "the robot sinks to its lowest pose in DAMP, where it holds"
                )
            )
            raise
        finally:
            if descent.phase is not DescentPhase.LOOKING:
                self._put_intent(sit=False)

    def _ask(self, ask: Ask, phase: DescentPhase, status: PlannerStatus | None) -> None:
        """Repeat the request; a simulated person keeps the hand off until the robot is down."""
        if ask in (Ask.SIT, Ask.STOP) and not self._seq:
            require_operator(self._robot, "down")
            if other := other_asker(status, self._source):
                raise FleetError(f"{other} requests something else of the robot; end that first")
            # the assist continues during the descent
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
