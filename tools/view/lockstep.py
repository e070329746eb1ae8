"""Frames of a robot in lockstep, in this process: a weak laptop's robot, and the tests'."""

from __future__ import annotations

import queue
import threading
import time
from typing import ClassVar, Final

from services.simulator.follower import Follower
from shared.bus import topics
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Lead, Restart, Scenario
from shared.robot.joints import MODULES
from tools.runs.lockstep import Lockstep
from tools.runs.standing_start import begin_standing
from tools.view.frame import Frame, Newest
from tools.view.source import Order, Source

HEIGHT_MAX_RATE: Final = 0.25
"""m/s: the hand then pulls with up to 70 N; at 0.5 m/s with 150 N, where the planner lets go."""
PITCH_MAX_RATE: Final = 1.0
"""rad/s"""
HEIGHTS: Final = (0.78, 1.2)
"""Of the hand, m: within what the legs reach."""
PITCHES: Final = (-0.3, 0.9)
PUSH_MAX: Final = 120.0
"""N, in each direction."""
PUSH_EXPIRES_S: Final = 0.3
"""After the last order: a page that is gone does not go on pushing."""
_FOREVER_S: Final = 1e9
_STEP_S: Final = 0.01
"""So much virtual time at once, then the orders."""


class _Watched(Lockstep):
    """A fleet that is looked at, and not recorded for re-execution."""

    traced: ClassVar[bool] = False


class LockstepSource(Source):
    """A robot in virtual time that keeps to real time, in a thread of its own."""

    kind = "lockstep"
    orders = ("hand", "push", "kill", "start", "estop")

    def __init__(self, robot: RobotConfig) -> None:
        super().__init__(robot)
        self.title = "a robot in this process, in virtual time"
        self._orders: queue.SimpleQueue[Order] = queue.SimpleQueue()
        self._newest = Newest(robot)
        self._lock = threading.Lock()
        self._frame: Frame | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lockstep", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join()

    def frame(self, t_s: float) -> Frame | None:  # noqa: ARG002 - it has no other time
        """Return the newest frame; None until it stands."""
        with self._lock:
            return self._frame

    def carry_out(self, order: Order) -> str:
        """Hand an order to the robot; return why not, or nothing."""
        if order.order not in self.orders:
            return f"{order.order!r} is no order; one of {', '.join(self.orders)}"
        if order.order in ("kill", "start") and order.service not in ("planner", *MODULES):
            return f"{order.service!r} has no process here; planner or a module"
        self._orders.put(order)
        return ""

    def _run(self) -> None:
        robot = self.robot
        height = robot.simulation.stand_height
        scenario = Scenario(
            name="view", about="", duration=_FOREVER_S, keyframe=(Keyframe(at=0.0, height=height),)
        )
        fleet = _Watched(robot, scenario, record=self._newest.take)
        begin_standing(fleet)
        hand = _Hand(height)
        due = time.monotonic()
        while not self._ended.is_set():
            while not self._orders.empty():
                self._carry_out(fleet, hand, self._orders.get())
            end_ns = fleet.now_ns + round(_STEP_S * NS_PER_S)
            hand.advance(fleet)
            while fleet.now_ns < end_ns:
                fleet.advance()
            truth = fleet.world.truth(fleet.now_ns, 1.0, 0.0)
            self._newest.take(topics.SIM_TRUTH, "", truth)
            found = self._newest.frame(fleet.now_ns)
            with self._lock:
                self._frame = found
            due = max(due + _STEP_S, time.monotonic() - 0.2)  # a slow machine: slow motion
            time.sleep(max(0.0, due - time.monotonic()))

    @staticmethod
    def _carry_out(fleet: Lockstep, hand: _Hand, order: Order) -> None:
        now_s = fleet.world.scenario_s
        if order.order == "estop":
            fleet.estop = True
        elif order.order == "kill":
            fleet.act(Kill(service=order.service, at=now_s))
        elif order.order == "start":
            fleet.act(Restart(service=order.service, at=now_s))
        else:
            hand.take(order, now_s)


class _Hand:
    """The person's hand as the page leads it."""

    def __init__(self, height: float) -> None:
        self._height, self._pitch = Follower(height, HEIGHT_MAX_RATE), Follower(0.0, PITCH_MAX_RATE)
        self._wanted = (height, 0.0)
        self._force = (0.0, 0.0, 0.0)
        self._pushed_s = -_FOREVER_S

    def take(self, order: Order, now_s: float) -> None:
        """Take what the page asks for, within its limits."""
        if order.order == "push":
            x, y, z = (min(max(part, -PUSH_MAX), PUSH_MAX) for part in order.force)
            self._force, self._pushed_s = (x, y, z), now_s
            return
        low, high = HEIGHTS
        back, front = PITCHES
        self._wanted = (
            min(max(order.height, low), high),
            min(max(order.pitch, back), front),
        )

    def advance(self, fleet: Lockstep) -> None:
        """Lead the robot's person for a step."""
        self._height.advance(self._wanted[0], _STEP_S)
        self._pitch.advance(self._wanted[1], _STEP_S)
        height, pitch = self._height, self._pitch
        world = fleet.world
        world.led = Lead(height.at, height.rate, pitch.at, pitch.rate, 0.0)
        lasts = world.scenario_s - self._pushed_s < PUSH_EXPIRES_S
        world.pushed = self._force if lasts else None
