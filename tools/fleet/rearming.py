"""End of an emergency stop: all six modules are re-armed together, or none of them.

A module that is re-armed alone holds while the other five sink, so the services of all stopped
modules restart at the same moment. Each drive holds with its own loop until its new service takes
it over; the take-over needs a planner.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping
from typing import Final

from shared.bus import topics
from shared.bus.messages import DriveStatus, JointState, Mode, PlannerStatus, Wrench, name_of
from shared.bus.session import Session, open_session
from shared.exceptions import FleetError
from shared.joints import MODULES
from tools.fleet.supervise import SupervisedFleet

PULL_MAX_N: Final = 40.0
"""Maximum force on the harness, N, about that of a leading hand. A simulated hand that still pulled
with 150 N raised the robot by 0.37 m within 0.7 s of the re-arming."""
HEARD_S: Final = 3.0
"""Timeout for the first message of each module and of a planner, s."""
REST_S: Final = 1.0
REST_RAD: Final = 0.01
"""A module that moves less than this within `REST_S` is at rest; rates are too noisy for this."""
READY_S: Final = 30.0
"""Timeout for all six modules to hold or track again, s."""
_UNHEARD_S: Final = 0.5
"""A module or planner is silent if its newest message is older than this, s."""
_POLL_S: Final = 0.01
_HOLDS: Final = (DriveStatus.ARMED, DriveStatus.HOLDING)
_PLANNER: Final = "planner"
_LIMP: Final = (
    "hang the robot, remove the cause that `xrl status` names, then run `xrl down` and `xrl up`"
)


def rearm(fleet: SupervisedFleet) -> float:
    """End the emergency stop; return the time until all six modules hold or track, s.

    Raises:
        FleetError: ending the stop is not safe, so nothing was changed; or a module does not hold
            or track in time.
    """
    with open_session(fleet.manifest.robot(), "rearm", fleet.run.path) as session:
        ear = _Ear(session)
        ear.listen_for_all()
        moved = ear.moved()
        here = set(fleet.pids())
        if why := hindrance(ear.states, moved, here, ear.pull_n, planner=ear.hears_planner):
            raise FleetError(f"nothing was re-armed: {why}")
        fleet.restart_together([m for m, row in ear.states.items() if row.mode == Mode.DAMP])
        return ear.wait_until_armed()


def hindrance(
    states: Mapping[str, JointState],
    moved: Collection[str],
    here: Collection[str],
    pull_n: float = 0.0,
    *,
    planner: bool,
) -> str:
    """Return why the emergency stop cannot be ended now; empty if it can.

    Args:
        states: newest state of each module that sends.
        moved: modules that have just moved.
        here: services that have a process on this host.
        pull_n: force on the harness, N; 0 if unknown.
        planner: True if a planner sends.
    """
    if silent := [module for module in MODULES if module not in states]:
        return f"no state from {', '.join(silent)}; run `xrl status`"
    stopped = [module for module in MODULES if states[module].mode == Mode.DAMP]
    if not stopped:
        return "no module is in DAMP, so no emergency stop is active"
    for module, state in states.items():
        if state.mode == Mode.FAULT or state.drive not in _HOLDS:
            mode, drive = name_of(Mode, state.mode), name_of(DriveStatus, state.drive)
            return f"{module} is in {mode}, its drive is {drive}; {_LIMP}"
    if elsewhere := [module for module in stopped if module not in here]:
        return f"no service of {', '.join(elsewhere)} on this host; run `xrl hosts down` and `up`"
    if moved:
        return f"{', '.join(moved)} still moving; wait until the robot is at rest"
    if pull_n > PULL_MAX_N:
        return (
            f"{pull_n:.0f} N on the harness would move the robot at once; reduce it below "
            f"{PULL_MAX_N:g} N (take hands and load off; move a simulated hand with `xrl lead`)"
        )
    return "" if planner else "taking over a drive needs a planner; run `xrl start planner`"


class _Ear:
    """Newest state of each module, newest force, and whether a planner sends its status."""

    def __init__(self, session: Session) -> None:
        self._latest = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in MODULES}
        self._statuses = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        self._wrenches = session.latest(topics.WRENCH, Wrench)
        self.pull_n = 0.0
        """Newest force on the harness, N; 0 if unknown."""
        self._newest: dict[str, JointState] = {}
        self._heard_s: dict[str, float] = {}

    def listen(self) -> None:
        """Receive new messages, after a short sleep."""
        time.sleep(_POLL_S)
        now_s = time.monotonic()
        for module, latest in self._latest.items():
            if (state := latest.take()) is not None:
                self._newest[module], self._heard_s[module] = state, now_s
        if self._statuses.take() is not None:
            self._heard_s[_PLANNER] = now_s
        if (wrench := self._wrenches.take()) is not None:
            self.pull_n = math.hypot(*wrench.force) if wrench.valid else 0.0

    def _hears(self, name: str) -> bool:
        return time.monotonic() - self._heard_s.get(name, -_UNHEARD_S) < _UNHEARD_S

    @property
    def hears_planner(self) -> bool:
        """True if a planner sends its status."""
        return self._hears(_PLANNER)

    @property
    def states(self) -> dict[str, JointState]:
        """Newest state of each module that is not silent."""
        return {module: state for module, state in self._newest.items() if self._hears(module)}

    def listen_for_all(self) -> None:
        """Wait for the first message of each module and of a planner, at most `HEARD_S`."""
        deadline_s = time.monotonic() + HEARD_S
        while time.monotonic() < deadline_s and not (
            self.hears_planner and len(self.states) == len(MODULES)
        ):
            self.listen()

    def moved(self) -> list[str]:
        """Receive for `REST_S`; return the modules that moved by more than `REST_RAD`."""
        before = self.states
        ends_s = time.monotonic() + REST_S
        while time.monotonic() < ends_s:
            self.listen()
        return [
            module
            for module, state in self.states.items()
            if module in before
            and max(abs(b - a) for a, b in zip(before[module].q, state.q, strict=True)) > REST_RAD
        ]

    def wait_until_armed(self) -> float:
        """Wait until all six hold or track, by their new states; return the time, s.

        Raises:
            FleetError: a module does not do so in time.
        """
        begin_s = time.monotonic()
        self._newest.clear()
        while True:
            self.listen()
            states = self.states
            armed = [m for m, row in states.items() if row.mode in (Mode.HOLD, Mode.TRACK)]
            taken_s = time.monotonic() - begin_s
            if len(armed) == len(MODULES):
                return taken_s
            if taken_s > READY_S:
                left = [
                    f"{m} {name_of(Mode, states[m].mode) if m in states else 'silent'}"
                    for m in MODULES
                    if m not in armed
                ]
                raise FleetError(
                    f"not armed after {READY_S:g} s: {', '.join(left)}; their drives still hold as "
                    "before; `xrl status` names the remedy"
                )
