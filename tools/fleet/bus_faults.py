"""What is wrong with the bus under `mtls`, for `xrl status`: links that TLS refuses, and floods."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from shared.bus import security
from shared.bus.credentials import Credentials, read_credentials
from shared.bus.security import TCP
from shared.bus.session import Session, peers_of
from shared.bus.sockets import Arrivals, addresses_of
from shared.bus.tls_probe import own_fault, refusal
from shared.clock import now_ns
from shared.config.endpoints import host_and_port
from shared.config.robot_config import SERVICES, RobotConfig
from shared.exceptions import BusError
from tools.fleet import procfs

_PROBES_AT_ONCE: Final = 16


class BusFaults:
    """Looks at the links that this host's services, and this tool, dial over TLS."""

    def __init__(self, robot: RobotConfig, session: Session) -> None:
        self._robot, self._session = robot, session
        self._here = security.services_here(robot)
        self._arrivals = Arrivals(security.ports_here(robot))
        self.begin()

    def begin(self) -> None:
        """Count from here on."""
        self._arrivals.flood(now_ns())

    def describe(self, pids: dict[str, int]) -> tuple[str, ...]:
        """Return what is wrong, in words; takes up to 2 s if a link does not come."""
        if self._robot.bus.security.mode != "mtls":
            return ()
        flood = self._arrivals.flood(now_ns())
        links = list(self._missing(pids))
        with ThreadPoolExecutor(_PROBES_AT_ONCE) as pool:
            found = pool.map(lambda link: refusal(link[1], link[3]), links)
            refused = [
                f"no link {dials} -> {peer} ({endpoint}): {why}"
                for (dials, _, peer, endpoint), why in zip(links, found, strict=True)
                if why
            ]
        return (*([flood] if flood else []), *self._own_faults(), *refused)

    def _own_faults(self) -> Iterator[str]:
        found: dict[str, list[str]] = {}
        for name in sorted(self._here):
            fault = own_fault(read_credentials(self._robot, name))
            if fault:
                found.setdefault(fault, []).append(name)
        for fault, names in found.items():
            yield f"no link over TLS: certificate of {', '.join(names)} {fault}"

    def _missing(self, pids: dict[str, int]) -> Iterator[tuple[str, Credentials, str, str]]:
        """Return who dials, as whom, which peer and where, for each link that is not there."""
        alive = self._session.alive()
        for dials, pid in (*pids.items(), (self._session.name, None)):
            if pid is not None and dials not in SERVICES:
                continue
            linked = set() if pid is None else procfs.connected(pid)
            for peer in peers_of(dials, self._robot.services):
                endpoint = security.endpoint_here(self._robot, peer, self._here)
                there = _is_in(endpoint, linked) if pid is not None else peer in alive
                if there or not endpoint.startswith(TCP):
                    continue
                try:
                    yield dials, read_credentials(self._robot, dials), peer, endpoint
                except BusError:  # its own log tells
                    break


def _is_in(endpoint: str, linked: Collection[tuple[str, int]]) -> bool:
    if not endpoint.startswith(TCP):
        return True
    host, port = host_and_port(endpoint)
    return any((str(address), port) in linked for address in addresses_of(host))
