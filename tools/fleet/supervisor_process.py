"""supervisord that needs no disk: `python -m tools.fleet.supervisor_process -- ARGUMENTS`.

Supervision must survive a full, read-only or vanished disk. A log line that cannot be written is
counted and dropped, and the next line tries the file again. The services outlive their supervisor,
because they keep the robot standing, and they still receive an emergency stop. With `--parent
PID`, the fleet belongs to a tool and has no real robot: it ends when that process or its supervisor
dies.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import time
from collections import deque
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any, ClassVar, Final

from supervisor import events, loggers, options, process, supervisord
from supervisor.options import ServerOptions, decode_wait_status
from supervisor.states import ProcessStates, getProcessStateDescription

from shared import scheduling
from shared.arguments import FlagParser
from shared.run_directory import FLEET_VARIABLE
from tools.fleet import kept_state
from tools.fleet.procfs import die_with_parent

BACKOFF_MAX_S: Final = 5.0
"""Maximum wait before a service that ends at once is restarted, s. supervisord adds a second each
time without limit: after 135 failed starts a repaired service stayed down for two minutes."""
LATELY_S: Final = 60.0
"""Window over which the ends of a service are counted, s."""
NEWEST_MAX: Final = 300
"""Maximum length of the newest log line that is kept, bytes."""


class _LogFile(loggers.Handler):  # type: ignore[misc]  # supervisor has no types
    """A log that rotates, is recreated after its folder was removed, and never raises."""

    lost = 0
    """Lines that could not be written, in all logs of this process."""
    why = ""
    """Reason why the newest of them was lost."""
    newest: ClassVar[dict[str, str]] = {}
    """Newest line of each file, even if it could not be written."""

    def __init__(self, filename: str, _mode: str, maxBytes: int, _backups: int) -> None:
        super().__init__(None)
        self.stream: FileIO | None = None
        self.baseFilename = filename
        self._max_bytes = maxBytes
        self._missing = 0
        with contextlib.suppress(OSError):
            self._open()

    def emit(self, record: loggers.LogRecord) -> None:
        """Write a record, or drop it if the disk rejects it."""
        message = record.msg
        text = message if isinstance(message, bytes) else (self.fmt % record.asdict()).encode()
        if words := text.strip():
            newest = words.rpartition(b"\n")[2][:NEWEST_MAX]
            _LogFile.newest[self.baseFilename] = newest.decode(errors="replace")
        try:
            self._open()
            if self._missing:
                self._write(f"(lines missing here: {self._missing}: {_LogFile.why})\n".encode())
                self._missing = 0
            self._write(text)
            if 0 < self._max_bytes <= Path(self.baseFilename).stat().st_size:
                Path(self.baseFilename).replace(f"{self.baseFilename}.1")
        except OSError as error:
            self.close()
            self._missing += 1
            _LogFile.lost, _LogFile.why = _LogFile.lost + 1, error.strerror or str(error)

    def flush(self) -> None:
        """Do nothing, because nothing is buffered."""

    def close(self) -> None:
        """Close the file; the next line reopens it."""
        if self.stream is not None:
            self.stream.close()
            self.stream = None

    reopen = close

    def remove(self) -> None:
        """Close the file and remove it."""
        self.close()
        Path(self.baseFilename).unlink(missing_ok=True)

    def _open(self) -> None:
        """Open the file unless it is open and still has its name."""
        path = Path(self.baseFilename)
        if self.stream is not None:
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(self.stream.fileno()), path.stat()):
                    return
            self.close()
        with contextlib.suppress(FileExistsError):
            path.parent.mkdir(mode=0o700)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
        self.stream = FileIO(os.open(path, flags, 0o600), "a")

    def _write(self, text: bytes) -> None:
        while text and self.stream is not None:
            text = text[self.stream.write(text) or 0 :]


class Service(process.Subprocess):  # type: ignore[misc]  # supervisor has no types
    """One service, which counts its starts and records how it ended, independently of its log."""

    starts = 0
    last_exit = ""
    delay: float

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self._ends_s: deque[float] = deque(maxlen=99)

    def spawn(self) -> Any:
        """Start the process."""
        pid = super().spawn()
        self.starts += pid is not None
        return pid

    def finish(self, pid: int, status: int) -> None:
        """Record how the process ended."""
        self.last_exit = decode_wait_status(status)[1]
        self._ends_s.append(time.monotonic())
        super().finish(pid, status)

    def change_state(self, new_state: int, expected: bool = True) -> Any:
        """Enter a new state, and limit the wait of a delayed start."""
        changed = super().change_state(new_state, expected)
        if new_state == ProcessStates.BACKOFF:
            self.delay = min(self.delay, time.time() + BACKOFF_MAX_S)
        return changed

    def row(self) -> dict[str, Any]:
        """Return the service's state as a row; XML-RPC has no None."""
        return {
            "name": self.config.name,
            "pid": self.pid or 0,
            "state": getProcessStateDescription(self.get_state()).lower(),
            "uptime_s": max(0.0, time.time() - self.laststart) if self.pid else 0.0,
            "starts": self.starts,
            "ends_lately": sum(time.monotonic() - end_s < LATELY_S for end_s in self._ends_s),
            "last_exit": self.last_exit or self.spawnerr or "",
            "last_line": _LogFile.newest.get(self.config.stdout_logfile, ""),
        }


class _FleetInterface:
    """The calls `xrl.services` and `xrl.logs` of `tools.fleet.supervisor_client`."""

    def __init__(self, supervisor: Any) -> None:
        self._supervisor = supervisor

    def services(self) -> list[dict[str, Any]]:
        """Return one row for each service."""
        groups = self._supervisor.process_groups.values()
        return [service.row() for group in groups for service in group.processes.values()]

    def logs(self) -> dict[str, Any]:
        """Return the number of lost log lines, and why the newest was lost."""
        return {"lost": _LogFile.lost, "why": _LogFile.why}


def make_interface(supervisor: Any, **_settings: str) -> _FleetInterface:
    """Return the calls that `xrl` adds; supervisord's configuration names this function."""
    return _FleetInterface(supervisor)


class _Options(ServerOptions):  # type: ignore[misc]  # supervisor has no types
    """supervisord's options and system calls."""

    leashed = False
    _supervisor_pid = os.getpid()

    def setpgrp(self) -> None:
        """Tie a leashed service to the supervisor; supervisord calls this right after fork."""
        super().setpgrp()
        if self.leashed:
            die_with_parent(self._supervisor_pid, signal.SIGKILL)

    def cleanup_fds(self) -> None:
        """Keep the inherited descriptors, because one of them holds the run directory's lock."""


def main() -> None:
    """Run supervisord in this process until it is stopped."""
    os.umask(0o077)  # for logs, sockets and shared memory
    # The tool that starts this process blocks signals during the start, and the mask is inherited.
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    parser = FlagParser(description=__doc__)
    parser.add_argument(
        "--parent", type=int, help="process id; stop the fleet when that process dies"
    )
    parser.add_argument(
        "arguments", nargs=argparse.REMAINDER, help="arguments of supervisord, after --"
    )
    args = parser.parse_args()
    if args.parent is not None:
        die_with_parent(args.parent, signal.SIGTERM)
        _Options.leashed = True
    loggers.RotatingFileHandler = _LogFile
    process.Subprocess = Service
    supervisord.ServerOptions = _Options
    # `run_dir.one_line` writes values literally, whatever characters they contain.
    options.UnhosedConfigParser = partial(options.UnhosedConfigParser, inline_comment_prefixes=None)
    options.expand = lambda value, _expansions, _name: value
    scheduling.keep_processors_awake()  # until this process ends; no service inherits it
    run_dir = Path(os.environ[FLEET_VARIABLE])
    events.subscribe(events.Tick5Event, lambda _event: kept_state.save(run_dir))
    supervisord.main([word for word in args.arguments if word != "--"])
    sys.stderr.close()  # on a full disk its flush would fail and change the exit code


if __name__ == "__main__":
    main()
