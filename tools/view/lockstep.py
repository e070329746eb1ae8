"""Frames of a robot in lockstep, in this process: for weak laptops and for tests."""

from __future__ import annotations

import queue
import threading
import time
from typing import Final

import msgspec

from shared.bus import topics
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Restart, Scenario
from shared.exceptions import RunError
from shared.joints import MODULES
from tools.sim.lockstep import Lockstep, begin_standing
from tools.view.frame import CUT_S, CUTS, Frame, HandOrders, Newest, Order, Source, without_fleet

_FOREVER_S: Final = 1e9
_STEP_S: Final = 0.01
"""Virtual time per step, s; orders are carried out between steps."""


class LockstepSource(Source):
    """A robot in virtual time, synchronised with real time, in its own thread."""

    kind = "lockstep"
    orders = ("hand", "push", "kill", "freeze", "start", "cut", "estop")
    processes = ("planner", *MODULES)

    def __init__(self, robot: RobotConfig) -> None:
        super().__init__(robot)
        self.title = "a robot in this process, in virtual time"
        self._orders: queue.SimpleQueue[Order] = queue.SimpleQueue()
        self._newest = Newest(robot)
        self._lock = threading.Lock()
        self._frame: Frame | None = None
        self._failed = ""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lockstep", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join()

    def frame(self) -> Frame | None:
        """Return the newest frame, or None until the robot stands."""
        if self._failed:
            raise RunError(self._failed)
        with self._lock:
            return self._frame

    def carry_out(self, order: Order) -> str:
        """Pass an order to the robot; return an error or an empty string."""
        if order.order not in self.orders:
            return f"{order.order!r} is not an order; must be one of {', '.join(self.orders)}"
        named = order.order in ("kill", "freeze", "start")
        if named and order.service not in self.processes:
            return f"{order.service!r} has no process here; must be planner or a module"
        if order.order == "cut" and order.service not in CUTS:
            return f"{order.service!r}: must be one of {', '.join(CUTS)}"
        self._orders.put(order)
        return ""

    def _run(self) -> None:
        try:
            self._live()
        except Exception as error:
            self._failed = f"the robot in this process has ended: {error}"
            raise  # so that the terminal shows it too

    def _live(self) -> None:
        robot = self.robot
        height = robot.simulation.stand_height
        scenario = Scenario(
            name="view", about="", duration=_FOREVER_S, keyframe=(Keyframe(at=0.0, height=height),)
        )
        fleet = Lockstep(robot, scenario, record=self._newest.add, planner_beside=True)
        begin_standing(fleet)
        hand = HandOrders()
        due = time.monotonic()
        while not self._ended.is_set():
            while not self._orders.empty():
                self._carry_out(fleet, hand, self._orders.get())
            end_ns = fleet.now_ns + round(_STEP_S * NS_PER_S)
            while fleet.now_ns < end_ns:
                fleet.advance()
            truth = fleet.world.truth(fleet.now_ns, 1.0, 0.0)
            self._newest.add(topics.SIM_TRUTH, "", truth)
            found = self._newest.frame(fleet.now_ns)
            if found is not None:
                network = fleet.network.active(fleet.world.scenario_s)
                found = without_fleet(msgspec.structs.replace(found, network=network))
            with self._lock:
                self._frame = found
            due = max(due + _STEP_S, time.monotonic() - 0.2)  # slow motion on a slow machine
            time.sleep(max(0.0, due - time.monotonic()))

    @staticmethod
    def _carry_out(fleet: Lockstep, hand: HandOrders, order: Order) -> None:
        now_s = fleet.world.scenario_s
        if order.order == "estop":
            fleet.estop = True
        elif order.order == "kill":
            fleet.act(Kill(service=order.service, at=now_s))
        elif order.order == "freeze":
            fleet.act(Kill(service=order.service, at=now_s, signal="STOP"))
        elif order.order == "cut":
            for link in CUTS[order.service]:
                fleet.network.cut(link, CUT_S, now_s, fleet.now_ns)
        elif order.order == "start":
            fleet.act(Restart(service=order.service, at=now_s))
        else:
            fleet.lead(hand.message(order))
