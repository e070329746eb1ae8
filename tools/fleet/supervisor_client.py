"""Client of supervisord, by XML-RPC over its UNIX socket."""

from __future__ import annotations

import xmlrpc.client
from collections.abc import Callable, Iterable, Mapping
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any, Final

import msgspec
from supervisor.xmlrpc import SupervisorTransport

from shared.exceptions import FleetError
from tools.fleet.procfs import is_suspended
from tools.fleet.run_dir import RunDir

_TIMEOUT_S = 3.0
UNSUPERVISED: Final = (
    "running services continue, and `xrl estop` works, but nothing restarts one that ends: "
    "hang the robot, then run `xrl down`"
)
"""Consequence of a dead supervisor, and the remedy."""


class ServiceInfo(msgspec.Struct, frozen=True):
    """One service, as reported by its supervisor and the kernel."""

    name: str
    pid: int | None
    """None while it has no process."""
    state: str
    """starting, running, suspended (SIGSTOP), stopping, or without a process: backoff
    (the next start is delayed), exited, fatal (not started again), stopped. Without a supervisor:
    unsupervised, suspended or gone."""
    uptime_s: float
    """Since its start; 0 while it has no process."""
    restarts: int = 0
    """Number of starts after the first one."""
    last_exit: str = ""
    """Its last end, for example "terminated by SIGKILL", or an empty string."""
    last_line: str = ""
    """Newest line of its log, even if it could not be written to disk."""
    ends_lately: int = 0
    """Number of ends within the last minute."""


class RefusedError(FleetError):
    """The supervisor answered, but refused the request."""


class Supervisor:
    """The supervisor of one run directory."""

    def __init__(self, run: RunDir) -> None:
        self._run = run

    def info(self, services: Iterable[str]) -> list[ServiceInfo]:
        """Return the state of these services, in this order."""
        rows = {row["name"]: row for row in self.call("xrl.services")}
        return [_service_info(rows[name]) for name in services]

    def lost_lines(self) -> tuple[int, str]:
        """Return the number of log lines that were not written, and why the newest was lost."""
        answer = self.call("xrl.logs")
        return answer["lost"], answer["why"]

    def call(self, method: str, *arguments: object) -> Any:
        """Call a method of the supervisor, given with its namespace, `supervisor` or `xrl`."""
        transport = _Transport(self._run.supervisor_socket)
        try:
            with xmlrpc.client.ServerProxy("http://localhost", transport=transport) as proxy:
                return getattr(proxy, method)(*arguments)
        except xmlrpc.client.Fault as fault:
            raise RefusedError(fault.faultString) from None
        except (OSError, HTTPException, xmlrpc.client.ProtocolError) as error:
            raise FleetError(
                f"the supervisor in {self._run.path} does not answer ({error}); {UNSUPERVISED}"
            ) from None


class _Transport(SupervisorTransport):  # type: ignore[misc]  # supervisor has no types
    """XML-RPC over the supervisor's socket, with a timeout."""

    def __init__(self, path: Path) -> None:
        super().__init__(None, None, f"unix://{path}")
        make: Callable[[], HTTPConnection] = self.__dict__["_get_connection"]

        def connect() -> HTTPConnection:
            connection = make()
            connection.connect()
            connection.sock.settimeout(_TIMEOUT_S)
            return connection

        self.__dict__["_get_connection"] = connect


def _service_info(row: Mapping[str, Any]) -> ServiceInfo:
    pid = row["pid"] or None
    suspended = pid is not None and is_suspended(pid)
    return ServiceInfo(
        name=row["name"],
        pid=pid,
        state="suspended" if suspended else row["state"],
        uptime_s=row["uptime_s"],
        restarts=max(0, row["starts"] - 1),
        last_exit=row["last_exit"],
        last_line=row["last_line"],
        ends_lately=row["ends_lately"],
    )
