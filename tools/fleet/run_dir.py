"""The run directory of one fleet and its live directory: contents, owner, and how to clear them."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shlex
import shutil
import stat
import time
from pathlib import Path
from typing import Final

import msgspec

from services.harness.loop import zero_path
from services.joint import neighbours, rearm_guard
from services.joint.rearm_guard import LastState, RearmGuard
from services.simulator.fronts import usb_standin
from shared import log
from shared.clock import PACE_FILE
from shared.config.files import load
from shared.config.robot_config import SERVICES, RobotConfig
from shared.exceptions import FleetError, os_error_in_words
from shared.joints import MODULES
from shared.run_directory import check_own, live_dir, make_live_dir
from tools.fleet import kept_state
from tools.fleet.process_table import SUPERVISOR_SOCKET, UNIX, FleetPlan, is_listening

SUPERVISOR_PID: Final = "supervisord.pid"
"""File with the supervisor's process id, written when the fleet starts."""
MARKER: Final = ".xrl-run"
"""File in every run directory. Without it, no tool removes files there, and a fleet starts there
only if there are no foreign files."""

ENDING_S: Final = 0.5
"""Timeout for the lock of a fleet whose processes were killed and are no longer found, s."""

_BY_HAND: Final = (
    "*.zenoh.lock", "*.rearm", "*.near", "*.heat", "*.zero", PACE_FILE, usb_standin.FOLDER,
    usb_standin.BUILT,
)  # fmt: skip
"""Names, besides sockets, that services started by hand leave in a run directory."""
_LOGGED: Final = (*SERVICES, "network_proxy", "ros2_gateway", "supervisord", "view")
"""Processes that have a log in a run directory."""

FILES_MIN: Final = 128
"""Minimum limit of open files for the supervisor, which needs three for each of about twelve
services."""
SPACE_MIN_MIB: Final = 4
"""Free space that a start needs in the run directory, for logs."""
SPACE_LOW_MIB: Final = 64
"""Free space below which `xrl status` warns: each of twelve logs may take 10 MB."""
_NEVER_GIVE_UP = 1_000_000
"""Maximum failed starts in a row (`supervisor_process.BACKOFF_MAX_S`)."""


class Manifest(msgspec.Struct, frozen=True):
    """Facts of a running fleet that later commands need."""

    config: str
    """The robot file, absolute."""
    services: tuple[str, ...]
    topics: dict[str, str]
    """Topic that each service publishes steadily, or an empty string."""
    sockets: tuple[str, ...]
    """Every socket that the services may leave behind."""
    stop_s: float
    """Longest time that a service may take to stop, s."""

    def robot(self) -> RobotConfig:
        """Return the robot that the robot file describes."""
        return load(Path(self.config))


class RunDir:
    """Paths in a run directory; nothing is created before `claim`."""

    def __init__(self, path: Path) -> None:
        self.path = Path(os.path.abspath(path))  # noqa: PTH100 - keeps symlinks: paths stay short
        self.marker = self.path / MARKER
        self.live = live_dir(self.path)
        self.pace = self.live / PACE_FILE
        self.supervisor_socket = self.live / SUPERVISOR_SOCKET
        self.supervisor_config = self.live / "supervisord.conf"
        self.supervisor_pid = self.path / SUPERVISOR_PID
        self.manifest = self.live / "fleet.json"
        self.logs = self.path / "logs"
        self.supervisor_log = self.logs / "supervisord.log"
        self.supervisor_stderr = self.logs / "supervisord.stderr"

    def log_of(self, service: str) -> Path:
        """Return the path of a service's log."""
        return self.logs / f"{service}.log"

    @property
    def is_marked(self) -> bool:
        """True for a directory of this user that belongs to a fleet."""
        check_own(self.path, alone=False)
        return self.marker.exists()

    def claim(self, *, alone: bool = True) -> int:
        """Create the directory, or use an empty one or a fleet's; mark it, and return its lock.

        The lock is a descriptor. The supervisor inherits it, so the lock lives as long as the
        supervisor. A killed process may hold the lock for a moment after it has disappeared:
        `ENDING_S`.
        """
        give_up_s = time.monotonic() + ENDING_S
        while True:
            descriptor = self._open(alone=alone)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(descriptor)
                if time.monotonic() < give_up_s:
                    time.sleep(ENDING_S / 50)
                    continue
                raise FleetError(
                    f"a fleet is up in {self.path}; stop it with `xrl down`, "
                    "or choose another directory with --run-dir"
                ) from None
            if self._is_current(descriptor):
                return self._marked(descriptor)
            os.close(descriptor)  # a `down` removed it before this process had the lock: retry

    def _open(self, *, alone: bool) -> int:
        check_own(self.path, alone=alone)
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            return os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            raise self._unusable(error) from None

    def _marked(self, descriptor: int) -> int:
        if self.is_marked:
            return descriptor
        try:
            foreign = self._foreign()
            if foreign is None:
                self.marker.touch(mode=0o600)
                return descriptor
        except OSError as error:
            os.close(descriptor)
            raise self._unusable(error) from None
        os.close(descriptor)
        raise FleetError(
            f"{self.path}: contains {foreign}, which does not belong to a fleet; choose a new or "
            "empty directory with --run-dir"
        )

    def _unusable(self, error: OSError) -> FleetError:
        return FleetError(f"{self.path}: cannot be a run directory: {os_error_in_words(error)}")

    def _foreign(self) -> str | None:
        """Return the name of a file here that is not a fleet's, or None."""
        if self.supervisor_log.exists():
            return None  # a fleet of an older version, without a mark
        for entry in sorted(self.path.iterdir()):
            by_hand = any(entry.match(pattern) for pattern in _BY_HAND)
            if not by_hand and not stat.S_ISSOCK(entry.lstat().st_mode):
                return entry.name
        return None

    def _is_current(self, descriptor: int) -> bool:
        try:
            return os.path.samestat(os.fstat(descriptor), self.path.stat())
        except FileNotFoundError:
            return False

    def prepare(self, plan: FleetPlan, pace: float = 1.0) -> None:
        """Remove old logs and dead sockets; write the files of the supervisor and the services.

        A nearly full disk does not prevent a disarmed start, because no person is there to react.
        """
        try:
            self._prepare(plan, pace)
            free_mib = free_mib_at(self.path)
        except OSError as error:
            raise FleetError(
                f"{os_error_in_words(error)}; a fleet keeps its logs in {self.path}, its sockets "
                f"and shared memory in {self.live}: choose another directory with --run-dir"
            ) from None
        if free_mib < SPACE_MIN_MIB and not plan.options.disarmed:
            raise FleetError(
                f"{self.path}: {free_mib:.1f} MiB free, but a fleet needs {SPACE_MIN_MIB} MiB "
                "there for its logs; free some space, or choose another --run-dir"
            )

    def _prepare(self, plan: FleetPlan, pace: float) -> None:
        disarmed = plan.options.disarmed
        make_live_dir(self.path)
        self.pace.unlink(missing_ok=True)
        if pace != 1.0:
            self.pace.write_text(f"{pace:g}\n", encoding="ascii")
        self._remove_shared_memory(keep_stops=disarmed)
        if not disarmed:
            self._remove_logs()
            kept_state.forget_stops(self.path)
            # after a crash of the supervisor a person may be resting on the harness
            zero_path(self.path).unlink(missing_ok=True)
        kept_state.restore(self.path)
        self.logs.mkdir(exist_ok=True)
        sockets = [item.endpoint for item in plan.listeners if item.endpoint.startswith(UNIX)]
        manifest = Manifest(
            config=str(plan.config_path),
            services=tuple(row.name for row in plan.processes),
            topics={row.name: row.topic for row in plan.processes},
            sockets=tuple(endpoint.removeprefix(UNIX) for endpoint in sockets),
            stop_s=max(row.stop_s for row in plan.processes),
        )
        self.manifest.write_bytes(msgspec.json.format(msgspec.json.encode(manifest)))
        self.supervisor_config.write_text(supervisor_config(self, plan), encoding="utf-8")
        for path in (*manifest.sockets, str(self.supervisor_socket)):
            _remove_socket(Path(path))
        if disarmed:
            for module in (name for name in manifest.services if name in MODULES):
                guard = RearmGuard(self.path, module)
                if guard.read() is LastState.NOTHING:
                    guard.write(LastState.HELD)

    def _remove_shared_memory(self, *, keep_stops: bool) -> None:
        """Remove an earlier fleet's shared memory; the rearm guards too, unless `keep_stops`."""
        neighbours.path_of(self.path).unlink(missing_ok=True)
        for module in () if keep_stops else MODULES:
            rearm_guard.path_of(self.path, module).unlink(missing_ok=True)

    def read_manifest(self) -> Manifest | None:
        """Return the manifest of the fleet that is or was up here, or None."""
        try:
            return msgspec.json.decode(self.manifest.read_bytes(), type=Manifest)
        except (OSError, msgspec.DecodeError):
            return None

    def clear(self, *, keep_logs: bool, keep_stops: bool = False) -> None:
        """Remove the fleet's files, and its two directories if they are then empty.

        Nothing is removed in a directory without a fleet's mark. Failed removals are logged.
        """
        if not self.is_marked:
            return
        saved = kept_state.save(self.path)
        try:
            self._clear_live(keep_stops=keep_stops, keep_heat=not saved)
            if not keep_stops:
                kept_state.forget_stops(self.path)
            self.supervisor_pid.unlink(missing_ok=True)
            if not keep_logs:
                self._remove_logs()
            if [entry.name for entry in self.path.iterdir()] == [MARKER]:
                self.marker.unlink()
                self.path.rmdir()
        except OSError as error:
            log.get("xrl").warning("some files could not be removed: %s", os_error_in_words(error))

    def _clear_live(self, *, keep_stops: bool, keep_heat: bool) -> None:
        manifest = self.read_manifest()
        for path in manifest.sockets if manifest else ():
            _remove_socket(Path(path))
        _remove_socket(self.supervisor_socket)
        self._remove_shared_memory(keep_stops=keep_stops)
        zero_path(self.path).unlink(missing_ok=True)
        for file in (self.supervisor_config, self.manifest, self.pace):
            file.unlink(missing_ok=True)
        if self.live != self.path:
            for heat in () if keep_heat else self.live.glob(kept_state.HEAT):
                heat.unlink()
            with contextlib.suppress(OSError):  # missing, or it contains a stop or other files
                self.live.rmdir()

    def _remove_logs(self) -> None:
        with contextlib.suppress(OSError):  # missing, or it contains other files
            for name in _LOGGED:
                for ending in (".log", ".log.1", ".stderr"):
                    (self.logs / f"{name}{ending}").unlink(missing_ok=True)
            self.logs.rmdir()


def free_mib_at(path: Path) -> float:
    """Return the free space on the disk of a directory, MiB."""
    return shutil.disk_usage(path).free / (1 << 20)


def supervisor_config(run: RunDir, plan: FleetPlan) -> str:
    """Return supervisord's configuration; services start in the plan's order."""
    factory = "supervisor.rpcinterface_factory"
    sections: dict[str, dict[str, object]] = {
        "unix_http_server": {"file": run.supervisor_socket, "chmod": "0700"},
        "supervisord": {
            "logfile": run.supervisor_log,
            "pidfile": run.supervisor_pid,
            "nodaemon": "true",
            "silent": "true",
            "nocleanup": "true",
            "minfds": FILES_MIN,
        },
        "rpcinterface:supervisor": {factory: "supervisor.rpcinterface:make_main_rpcinterface"},
        # from tools.fleet.supervisor_process, which is the main module there
        "rpcinterface:xrl": {factory: "__main__:make_interface"},
    }
    for priority, row in enumerate(plan.processes):
        restarts = row.name not in plan.options.no_restart
        sections[f"program:{row.name}"] = {
            "command": shlex.join(plan.commands[row.name]),
            "process_name": row.name,
            "priority": priority,
            "autostart": str(row.autostart).lower(),
            "autorestart": str(restarts).lower(),
            "startsecs": row.settle_s,
            "startretries": _NEVER_GIVE_UP if restarts else 0,
            "stopsignal": row.stop_signal,
            "stopwaitsecs": row.stop_s,
            "stopasgroup": "true",
            "killasgroup": "true",
            "redirect_stderr": "true",
            "stdout_logfile": run.log_of(row.name),
            "stdout_logfile_maxbytes": "5MB",
            "stdout_logfile_backups": 1,
        }
    lines: list[str] = []
    for name, settings in sections.items():
        pairs = (f"{key}={one_line(value)}" for key, value in settings.items())
        lines += [f"[{name}]", *pairs, ""]
    return "\n".join(lines)


def one_line(value: object) -> str:
    """Return a value as it is written to supervisord's file.

    `tools.fleet.supervisor_process` reads values without trailing comments and expands nothing,
    so only a line break is special.
    """
    text = str(value)
    if "\n" in text or "\r" in text:
        raise FleetError(f"{text!r}: a path or argument of a service has a line break; rename it")
    return text


def _remove_socket(path: Path) -> None:
    """Remove a socket without a listener, and the lock that Zenoh creates beside it."""
    if path.exists() and stat.S_ISSOCK(path.lstat().st_mode) and not is_listening(f"{UNIX}{path}"):
        path.unlink(missing_ok=True)
    lock = Path(f"{path}.lock")
    if not path.exists():
        lock.unlink(missing_ok=True)
