"""Frames of a live fleet; subscribed only while somebody looks, and acted on only when allowed."""

from __future__ import annotations

import threading
from typing import Any, Final

import msgspec

from shared.bus.session import Latest, Session, open_session
from shared.bus.topics import Topic
from shared.clock import now_ns
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tools.fleet.fleet_status import impairments
from tools.fleet.supervise import SupervisedFleet
from tools.view.frame import SHOWN, SHOWN_OF_MODULES, Frame, Newest, ShownProcess
from tools.view.live_orders import LiveOrders
from tools.view.source import Order, Source

LOOK_S: Final = 1.0
"""The supervisor is asked so often how its processes do."""


class LiveSource(Source):
    """The fleet whose sockets are in a run directory, or at the robot file's hosts."""

    kind = "live"

    def __init__(self, robot: RobotConfig, fleet: SupervisedFleet, *, act: bool = False) -> None:
        super().__init__(robot)
        self.title = f"live, {fleet.run.path}"
        self._fleet = fleet
        self._session: Session | None = None
        self._latest: list[tuple[Topic, str, Latest[Any]]] = []
        self._newest = Newest(robot)
        self._acting = LiveOrders(robot, fleet, self._scenario_s) if act else None
        if self._acting is not None:
            self.orders = self._acting.orders
            self.processes = self._acting.services
        self._processes: tuple[ShownProcess, ...] = ()
        self._network: tuple[str, ...] = ()
        self._left = threading.Event()
        self._looker: threading.Thread | None = None

    def connect(self) -> None:
        """Subscribe."""
        if self._session is not None:
            return
        session = self._session = open_session(self.robot, "view", self._fleet.run.path)
        self._newest.clear()
        wanted = [(topic, "") for topic in SHOWN]
        wanted += [(t, m) for t in SHOWN_OF_MODULES for m in MODULES]
        self._latest = [(t, m, session.latest(t, t.type, m)) for t, m in wanted]
        if self._acting is not None:
            self._acting.begin(session)
        self._left.clear()
        self._looker = threading.Thread(target=self._look, name="processes", daemon=True)
        self._looker.start()

    def disconnect(self) -> None:
        """Leave the bus."""
        session, self._session, self._latest = self._session, None, []
        if session is None:
            return
        self._left.set()
        if self._looker is not None:
            self._looker.join()
        if self._acting is not None:
            self._acting.end()
        session.close()

    def frame(self, t_s: float) -> Frame | None:  # noqa: ARG002 - a live fleet has no other time
        """Return the newest frame."""
        for topic, module, latest in self._latest:
            message = latest.take()
            if message is not None:
                # by its arrival: its own time is its host's, which may be another
                message = msgspec.structs.replace(message, t_ns=now_ns())
                self._newest.take(topic, module, message)
        found = self._newest.frame(now_ns())
        if found is None:
            return None
        return msgspec.structs.replace(found, processes=self._processes, network=self._network)

    def carry_out(self, order: Order) -> str:
        """Do what a page asks for, if it may; may block for some seconds."""
        if self._acting is None:
            return f"{order.order}: this page only looks; `xrl view --act` lets it act"
        return self._acting.carry_out(order)

    def _scenario_s(self) -> float:
        return self._newest.scenario_s

    def _look(self) -> None:
        """Ask the supervisor and the network proxy, until nobody looks any more."""
        while not self._left.is_set():
            try:
                rows = self._fleet.info()
                self._processes = tuple(ShownProcess(r.name, r.state, r.restarts) for r in rows)
                self._network = impairments(self._fleet)
            except Exception as error:  # noqa: BLE001 - told on the page, whatever it is
                self._processes, self._network = (), (f"not known: {error}",)
            self._left.wait(LOOK_S)
