"""Leads a live robot through the motions of `deploy/scenarios/identify.toml`, and listens.

The robot's own limits stay in force: shifts and assist are asked for as any operator asks, and the
planner limits them. Height and pitch are led by a hand: the simulated one, or a person who is told
where to lead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from shared.bus import topics
from shared.bus.messages import HandLead, JointState, PlannerStatus, Wrench
from shared.bus.session import Session
from shared.clock import now_ns
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Lead, Scenario, lead
from shared.joints import MODULES
from tools.bringup.identify.quasi_static import TimedRows
from tools.fleet.led_planner import LedPlanner

ASK_S: Final = 0.02

Progress = Callable[[float, Lead, PlannerStatus], None]


class LeadRecord(NamedTuple):
    """What was heard meanwhile, by arrival."""

    states: tuple[TimedRows[JointState], ...]
    """One stream for each of the six modules."""
    wrenches: TimedRows[Wrench]
    ended: str
    """Why it ended before its time; "" if it did not."""


class BodyLead:
    """A robot that is led."""

    def __init__(self, robot: RobotConfig, session: Session, *, simulated: bool) -> None:
        """Meet the robot; a simulated hand leads height and pitch."""
        self._robot = robot
        self._hand = session.publisher(topics.OPERATOR_HAND, HandLead) if simulated else None
        self._states = [session.latest(topics.JOINT_STATE, JointState, name) for name in MODULES]
        self._wrench = session.latest(topics.WRENCH, Wrench)
        self._planner = LedPlanner(session, "identify")
        self._sent = 0

    def go(self, scenario: Scenario, progress: Progress, stopped: Callable[[], bool]) -> LeadRecord:
        """Lead through a scenario's keyframes; return all that was heard."""
        states: list[tuple[list[int], list[JointState]]] = [([], []) for _ in MODULES]
        wrenches: tuple[list[int], list[Wrench]] = ([], [])

        def ask(t_s: float) -> None:
            wanted = self._limited(lead(scenario, t_s))
            self._ask(wanted)
            progress(t_s, wanted, self._planner.status)

        def listen() -> None:
            for (t_ns, rows), source in zip(states, self._states, strict=True):
                if (state := source.take()) is not None:
                    t_ns.append(now_ns())
                    rows.append(state)
            if (wrench := self._wrench.take()) is not None:
                wrenches[0].append(now_ns())
                wrenches[1].append(wrench)
            self._planner.listen()

        ended = self._planner.lead(scenario.duration, ask, listen, stopped, every_s=ASK_S)
        return LeadRecord(tuple(TimedRows(*one) for one in states), TimedRows(*wrenches), ended)

    def _limited(self, wanted: Lead) -> Lead:
        x, y, roll, yaw = (
            max(-most, min(most, value))
            for value, most in zip(wanted.shift, self._robot.law.shift_max, strict=True)
        )
        assist = min(wanted.assist, self._robot.assist.force_max)
        return wanted._replace(shift=(x, y, roll, yaw), assist=assist)

    def _ask(self, wanted: Lead) -> None:
        self._planner.ask(assist_n=wanted.assist, shift=wanted.shift)
        if self._hand is None:
            return
        self._sent += 1
        self._hand.put(
            HandLead(
                t_ns=now_ns(), seq=self._sent, leads=True, height=wanted.height,
                pitch=wanted.pitch, push=(0.0, 0.0, 0.0), source=self._planner.source,
            )
        )  # fmt: skip
