"""What supervisord says of its services, by XML-RPC over its UNIX socket and by its log."""

from __future__ import annotations

import contextlib
import re
import xmlrpc.client
from collections.abc import Callable, Iterable, Mapping
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any

import msgspec
from supervisor.xmlrpc import SupervisorTransport

from shared.exceptions import FleetError
from tools.fleet.procfs import is_suspended
from tools.fleet.run_dir import RunDir

_TIMEOUT_S = 3.0
_ENDED = re.compile(r"(?:exited|stopped): (\S+) \((.*?)(?:; (?:not )?expected)?\)$")
_SPAWNED = re.compile(r"spawned: '(\S+)' with pid \d+$")


class ServiceInfo(msgspec.Struct, frozen=True):
    """One service as its supervisor and the kernel see it."""

    name: str
    pid: int | None
    """None while it has no process."""
    state: str
    """starting, running, suspended (SIGSTOP), stopping, or without a process: backoff
    (the next start is delayed), exited, fatal (not started again), stopped."""
    uptime_s: float
    """Since its start, in whole seconds; 0 while it has no process."""
    restarts: int
    """Starts since the first one, wanted or not."""
    last_exit: str
    """How it ended last, for example "terminated by SIGKILL"; empty if it never has."""


class RefusedError(FleetError):
    """The supervisor answered and refused the request."""


class Supervisor:
    """The supervisor of one run directory."""

    def __init__(self, run: RunDir) -> None:
        self._run = run

    def pids(self) -> dict[str, int]:
        """Return the process id of each service that has a process."""
        return {row["name"]: row["pid"] for row in self.call("getAllProcessInfo") if row["pid"]}

    def info(self, services: Iterable[str]) -> list[ServiceInfo]:
        """Return these services, in this order."""
        rows = {row["name"]: row for row in self.call("getAllProcessInfo")}
        starts, ends = self._history()  # after the states: it then explains them
        return [
            _service_info(rows[name], starts.get(name, 0), ends.get(name, "")) for name in services
        ]

    def call(self, method: str, *arguments: object) -> Any:
        """Call the supervisor.

        Raises:
            FleetError: it does not answer.
            RefusedError: it refuses the request.
        """
        transport = _Transport(self._run.supervisor_socket)
        try:
            with xmlrpc.client.ServerProxy("http://localhost", transport=transport) as proxy:
                return getattr(proxy.supervisor, method)(*arguments)
        except xmlrpc.client.Fault as fault:
            raise RefusedError(fault.faultString) from None
        except (OSError, HTTPException, xmlrpc.client.ProtocolError) as error:
            raise FleetError(
                f"the supervisor in {self._run.path} does not answer ({error}); "
                "`xrl down` clears it away"
            ) from None

    def _history(self) -> tuple[dict[str, int], dict[str, str]]:
        """Return how often each service was started and how it ended last."""
        starts: dict[str, int] = {}
        ends: dict[str, str] = {}
        with contextlib.suppress(FileNotFoundError):
            for line in self._run.supervisor_log.read_text(encoding="utf-8").splitlines():
                if match := _SPAWNED.search(line):
                    starts[match[1]] = starts.get(match[1], 0) + 1
                elif match := _ENDED.search(line):
                    ends[match[1]] = match[2]
        return starts, ends


class _Transport(SupervisorTransport):  # type: ignore[misc]  # supervisor has no types
    """XML-RPC over the supervisor's socket, with a time limit."""

    def __init__(self, path: Path) -> None:
        super().__init__(None, None, f"unix://{path}")
        make: Callable[[], HTTPConnection] = self.__dict__["_get_connection"]

        def connect() -> HTTPConnection:
            connection = make()
            connection.connect()
            connection.sock.settimeout(_TIMEOUT_S)
            return connection

        self.__dict__["_get_connection"] = connect


def _service_info(row: Mapping[str, Any], starts: int, last_exit: str) -> ServiceInfo:
    pid = row["pid"] or None
    suspended = pid is not None and is_suspended(pid)
    return ServiceInfo(
        name=row["name"],
        pid=pid,
        state="suspended" if suspended else row["statename"].lower(),
        uptime_s=float(row["now"] - row["start"]) if pid else 0.0,
        restarts=max(0, starts - 1),
        last_exit=last_exit,
    )
