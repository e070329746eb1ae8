"""Lowers a robot that is up, over the bus, before its drives go limp (`tools.live.descent`)."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from shared.bus import topics
from shared.bus.credentials import require_operator
from shared.bus.messages import Estop, JointState, OperatorIntent, PlannerStatus
from shared.bus.session import Session, open_session
from shared.clock import now_ns
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.exceptions import BusError, FleetError
from shared.joints import MODULES
from shared.places import user_name
from tools.live.descent import WAYS, Ask, Descent, DescentPhase

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
