"""Leads a live robot through the motions of `deploy/scenarios/identify.toml`, and listens.

The robot's own limits stay in force: shifts and assist are asked for as any operator asks, and the
planner limits them. Height and pitch are led by a hand: the simulated one, or a person who is told
where to lead. Whatever ends it, nothing is asked for any more, and the requests fade out.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, NamedTuple

from shared.bus import topics
from shared.bus.messages import HandLead, JointState, PlannerStatus, Wrench
from shared.bus.session import Session
from shared.clock import NS_PER_S, now_ns
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Lead, Scenario, lead
from shared.joints import MODULES
from tools.fleet.led_planner import LedPlanner
from tools.identify.quasi_static import TimedRows

ASK_S: Final = 0.02
"""Between two requests: an intent fades out once nobody repeats it."""
LISTEN_S: Final = 0.002

Progress = Callable[[float, Lead, PlannerStatus], None]


class MotionRecord(NamedTuple):
    """What was heard meanwhile, by arrival."""

    states: tuple[TimedRows[JointState], ...]
    """One stream for each of the six modules."""
    wrenches: TimedRows[Wrench]
    ended: str
    """Why it ended before its time; "" if it did not."""


class Motion:
    """A robot that is led."""

    def __init__(self, robot: RobotConfig, session: Session, *, simulated: bool) -> None:
        """Meet the robot.

        Args:
            robot: its file; limits what is asked for.
            session: of an operator.
            simulated: a simulated hand leads height and pitch.

        Raises:
            FleetError: the robot is silent, does not lead, or somebody else asks it for something.
        """
        self._robot = robot
        self._hand = session.publisher(topics.OPERATOR_HAND, HandLead) if simulated else None
        self._states = [session.latest(topics.JOINT_STATE, JointState, name) for name in MODULES]
        self._wrench = session.latest(topics.WRENCH, Wrench)
        self._planner = LedPlanner(session, "identify")
        self._sent = 0

    def go(
        self, scenario: Scenario, progress: Progress, stopped: Callable[[], bool]
    ) -> MotionRecord:
        """Lead through a scenario's keyframes; return all that was heard.

        Args:
            scenario: its hand's path; nothing else of it is used.
            progress: receives time, request and the planner's status now and then.
            stopped: True to end it.
        """
        states: list[tuple[list[int], list[JointState]]] = [([], []) for _ in MODULES]
        wrenches: tuple[list[int], list[Wrench]] = ([], [])
        begin = now_ns()
        ask_s, ended = 0.0, ""
        while not ended and (t_s := (now_ns() - begin) / NS_PER_S) < scenario.duration:
            if t_s >= ask_s:
                wanted = self._limited(lead(scenario, t_s))
                self._ask(wanted)
                progress(t_s, wanted, self._planner.status)
                ask_s = t_s + ASK_S
            for (t_ns, rows), source in zip(states, self._states, strict=True):
                if (state := source.take()) is not None:
                    t_ns.append(now_ns())
                    rows.append(state)
            if (wrench := self._wrench.take()) is not None:
                wrenches[0].append(now_ns())
                wrenches[1].append(wrench)
            self._planner.listen()
            ended = "stopped" if stopped() else self._planner.trouble()
            time.sleep(LISTEN_S)
        return MotionRecord(tuple(TimedRows(*one) for one in states), TimedRows(*wrenches), ended)

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
