"""Frames of a live fleet, and a page's actions on it.

The source subscribes only while a page is open, and acts only if allowed.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from typing import Any, Final

import msgspec

from shared.bus import topics
from shared.bus.credentials import require_operator
from shared.bus.messages import HandLead, RunEvent, RunEventKind
from shared.bus.pubsub import Latest, Publisher
from shared.bus.session import Session, open_session
from shared.bus.topics import Topic
from shared.clock import now_ns
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject
from shared.exceptions import FleetError, XrlError
from shared.joints import MODULES
from tools.fleet.emergency_stop import BusStop, request_here
from tools.fleet.fleet_status import impairments
from tools.fleet.proxy_client import ProxyClient
from tools.fleet.supervise import SupervisedFleet
from tools.view.frame import (
    CUT_S,
    CUTS,
    SHOWN,
    Frame,
    HandOrders,
    Newest,
    Order,
    ShownProcess,
    Source,
)


class LiveOrders:
    """Carries out a page's orders.

    Attributes:
        services: services that can be killed, frozen and started; the planner first.
        orders: orders that this fleet accepts; `hand` and `push` only with a simulator, `cut` only
            with a network proxy.
    """

    def __init__(
        self, robot: RobotConfig, fleet: SupervisedFleet, scenario_s: Callable[[], float]
    ) -> None:
        require_operator(robot, "view")
        self._robot, self._fleet, self._scenario_s = robot, fleet, scenario_s
        self.services = tuple(sorted(fleet.manifest.services, key=lambda name: name != "planner"))
        self._carriers: dict[str, Callable[[Order], None]] = {
            "estop": self._estop,
            "kill": self._kill,
            "freeze": self._freeze,
            "start": self._start,
        }
        if "network_proxy" in self.services:
            self._carriers["cut"] = self._cut
        if "simulator" in self.services:
            self._carriers |= {"hand": self._lead, "push": self._lead}
        self.orders = tuple(self._carriers)
        self._hand = HandOrders()
        self._publisher: Publisher[HandLead] | None = None
        self._events: Publisher[RunEvent] | None = None
        self._stop: BusStop | None = None
        self._led = self._told = 0

    def begin(self, session: Session) -> None:
        """Use a session, which is open while a page is open."""
        self._hand = HandOrders()
        self._publisher = session.publisher(topics.OPERATOR_HAND, HandLead)
        self._events = session.publisher(topics.RUN_EVENT, RunEvent)
        self._stop = BusStop(self._robot, session, self._fleet.run.path)

    def end(self) -> None:
        """Release the session before it closes."""
        self._publisher = self._events = self._stop = None

    def carry_out(self, order: Order) -> str:
        """Carry out an order; return an error or an empty string. May block for some seconds."""
        carrier = self._carriers.get(order.order)
        if carrier is None:
            return f"{order.order!r} is not an order here; must be one of {', '.join(self.orders)}"
        try:
            carrier(order)
        except (XrlError, OSError) as error:  # a process may end before the signal
            return str(error)
        return ""

    def _lead(self, order: Order) -> None:
        publisher = self._publisher
        if publisher is None:
            raise FleetError("there is no link to the bus yet")
        self._led += 1
        asked = self._hand.message(order)
        publisher.put(msgspec.structs.replace(asked, t_ns=now_ns(), seq=self._led))

    def _estop(self, _order: Order) -> None:
        """Stop all modules, first through shared memory."""
        request_here(self._fleet.run.path)
        stop = self._stop
        if stop is None:
            raise FleetError(
                "stopped through shared memory only, on this host: there is no link to the bus"
            )
        going = stop.stop()
        if going:
            raise FleetError(f"not stopped: {', '.join(going)}; cut the power")

    def _kill(self, order: Order) -> None:
        # a person starts the next process deliberately, so it may arm the drive
        fault = self._fleet.forget(order.service) if order.service in MODULES else ""
        self._fleet.kill(order.service, signal.SIGKILL)
        self._tell(RunEventKind.KILLED, order.service, "KILL")
        if fault:
            raise FleetError(f"killed, but {fault}")

    def _freeze(self, order: Order) -> None:
        self._fleet.kill(order.service, signal.SIGSTOP)
        self._tell(RunEventKind.KILLED, order.service, "STOP")

    def _start(self, order: Order) -> None:
        crash_loop = self._fleet.crash_loop(order.service)
        self._fleet.start_service(order.service)
        self._tell(RunEventKind.RESTARTED, order.service, "")
        if crash_loop:
            raise FleetError(crash_loop)

    def _tell(self, kind: RunEventKind, subject: str, detail: str) -> None:
        events = self._events
        if events is not None:
            self._told += 1
            event = RunEvent(
                t_ns=now_ns(),
                seq=self._told,
                kind=int(kind),
                subject=subject,
                detail=detail,
                scenario_s=self._scenario_s(),
            )
            events.put(event)

    def _cut(self, order: Order) -> None:
        links = CUTS.get(order.service)
        if links is None:
            raise FleetError(f"{order.service!r}: must be one of {', '.join(CUTS)}")
        proxy = ProxyClient(self._fleet.run.path)
        for link in links:
            proxy.begin(Inject(link=link, at=0.0, duration=CUT_S, partition=True))


LOOK_S: Final = 1.0
"""Period at which supervisor and network proxy are queried, s."""


class LiveSource(Source):
    """Frames of the fleet of a run directory."""

    kind = "live"

    def __init__(self, robot: RobotConfig, fleet: SupervisedFleet, *, act: bool = False) -> None:
        super().__init__(robot)
        self.title = f"live, {fleet.run.path}"
        self._fleet = fleet
        self._session: Session | None = None
        self._latest: list[tuple[Topic, str, Latest[Any]]] = []
        self._newest = Newest(robot)
        self._acting = LiveOrders(robot, fleet, lambda: self._newest.scenario_s) if act else None
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
        self._latest = [
            (t, m, (session.latest if t.batch is None else session.latest_in_batch)(t, t.type, m))
            for t, m in SHOWN
        ]
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

    def frame(self) -> Frame | None:
        """Return the newest frame."""
        for topic, module, latest in self._latest:
            message = latest.take()
            if message is not None:
                # by its arrival, because its own stamp may be on another host's clock
                message = msgspec.structs.replace(message, t_ns=now_ns())
                self._newest.add(topic, module, message)
        found = self._newest.frame(now_ns())
        if found is None:
            return None
        return msgspec.structs.replace(found, processes=self._processes, network=self._network)

    def carry_out(self, order: Order) -> str:
        """Carry out a page's order, if allowed; may block for some seconds."""
        if self._acting is None:
            return f"{order.order}: this page cannot act; `xrl view --act` lets it act"
        return self._acting.carry_out(order)

    def _look(self) -> None:
        """Query the supervisor and the network proxy until the last page has closed."""
        while not self._left.is_set():
            try:
                rows = self._fleet.info()
                self._processes = tuple(ShownProcess(r.name, r.state, r.restarts) for r in rows)
                self._network = impairments(self._fleet)
            except Exception as error:  # noqa: BLE001 - the page shows any error
                self._processes, self._network = (), (f"unknown: {error}",)
            self._left.wait(LOOK_S)
