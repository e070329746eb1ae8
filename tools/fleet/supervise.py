"""A fleet of services under supervisord: start, inspect, signal, stop.

supervisord restarts services that end (`tools.fleet.supervisor_process`). If it dies, a robot's
services keep running, so the robot stands; `tools.fleet.procfs` finds them by their environment.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Self

from services.joint import rearm_guard
from services.simulator.fronts import usb_standin
from shared import log
from shared.exceptions import FleetError, os_error_in_words
from shared.run_directory import FLEET_VARIABLE, check_own, private_files
from tools.fleet import process_table, procfs
from tools.fleet.pace import check_pace, usual_pace
from tools.fleet.process_table import FleetOptions, FleetPlan, Process
from tools.fleet.run_dir import FILES_MIN, Manifest, RunDir
from tools.fleet.supervisor_client import RefusedError, ServiceInfo, Supervisor

_POLL_S = 0.1
_LOOK_S = 0.5
"""Period of the check of a start's progress, s."""
_USED_S = 0.05
"""CPU time that counts as progress, s."""
START_MAX_S = 600.0
"""Timeout of a start that makes progress, s."""
_KILLED_S = 5.0  # timeout for the kernel to clear away killed processes
_LOOPS = 3
"""Number of ends within a minute that make a crash loop."""
_FAILED = ("backoff", "exited", "fatal")
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_BY_DEFAULT = FleetOptions()


class SupervisedFleet:
    """The services of one run directory."""

    def __init__(self, run_dir: Path) -> None:
        """Refer to a fleet that may be up; `start` and `attach` check it."""
        self.run = RunDir(run_dir)
        self._supervisor = Supervisor(self.run)
        self._process: subprocess.Popen[bytes] | None = None

    @classmethod
    def start(cls, config_path: Path, run_dir: Path, options: FleetOptions = _BY_DEFAULT) -> Self:
        """Start the services of a robot file and wait until every service is up.

        If the start is interrupted or fails, it ends the started services. After a failure their
        logs remain. With `disarmed`, a service that does not start ends no other.

        Raises:
            ConfigError: the robot file or the table cannot be used.
            FleetError: the run directory or an endpoint is in use; a service is unknown,
                ends at once or is not up in time; or USB drives must be emulated and
                there is no C compiler.
        """
        started = cls(run_dir)
        plan = process_table.make_plan(config_path, started.run.path, options)
        process_table.check_known(options.no_restart, list(plan.commands))
        simulated = "simulator" in plan.commands
        clock_pace = options.pace
        if clock_pace is None:
            clock_pace = usual_pace() if simulated else 1.0
        check_pace(clock_pace, simulated=simulated)
        files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        if 0 <= files < FILES_MIN:
            raise FleetError(
                f"limit of open files: {files}, but {FILES_MIN} are needed; raise it (`ulimit -Hn`)"
            )
        lock = started.run.claim()
        try:
            started._end_unsupervised(take_over=options.disarmed and not simulated)
            started._start(plan, lock, clock_pace)
        finally:
            os.close(lock)
        return started

    @classmethod
    def attach(cls, run_dir: Path, *, warn: bool = True) -> Self:
        """Return the fleet that is up in a run directory."""
        attached = cls(run_dir)
        run = attached.run
        check_own(run.path)
        running = procfs.fleet_pids(run.path)
        if run.read_manifest() is None:
            if running:
                raise FleetError(
                    f"{run.path}: a fleet runs here (processes: {len(running)}), but its files are "
                    "gone; `xrl estop` stops the robot, `xrl down` ends the processes"
                )
            raise _not_up(run)
        if fault := attached.supervision_fault():
            if not running:
                raise _not_up(run, f" ({fault})")
            if warn:
                log.get("xrl").warning("%s", fault)
        return attached

    def supervision_fault(self) -> str:
        """Return why ended services are not restarted, and the remedy; empty without a fault."""
        try:
            self._supervisor.call("supervisor.getState")
        except FleetError as error:
            return str(error)
        return ""

    @property
    def manifest(self) -> Manifest:
        """Facts of the start: robot file, services, topics."""
        manifest = self.run.read_manifest()
        if manifest is None:
            raise _not_up(self.run)
        return manifest

    def info(self) -> list[ServiceInfo]:
        """Return every service, in the order of the process table."""
        names = self.manifest.services
        try:
            return self._supervisor.info(names)
        except FleetError:
            if pids := self.pids():
                return [_unsupervised(name, pids.get(name)) for name in names]
            raise

    def lost_lines(self) -> tuple[int, str]:
        """Return the number of log lines that could not be written, and why; 0 if unknown."""
        try:
            return self._supervisor.lost_lines()
        except FleetError:
            return 0, ""

    def pids(self) -> dict[str, int]:
        """Return the process id of each service that has a process."""
        return procfs.service_pids(self.run.path)

    def kill(self, service: str, number: int = signal.SIGKILL) -> int:
        """Send a signal to a service at once, and return the process id."""
        process_table.check_known([service], self.manifest.services)
        pid = self.pids().get(service)
        if pid is None:
            raise FleetError(f"{service} has no process to signal now; see `xrl status`")
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            raise FleetError(f"{service} (pid {pid}) has just ended on its own") from None
        return pid

    def forget(self, service: str) -> str:
        """Let the next process of a joint service arm its drive, whatever state the last one left.

        Returns:
            Reason for a failure, which is also logged; empty if the state is cleared.
        """
        try:
            rearm_guard.clear(self.run.path, service)
        except OSError as error:
            fault = (
                f"{service}: the state of its last process cannot be cleared, so its next process "
                f"arms no drive: {os_error_in_words(error)}"
            )
            log.get("xrl").warning("%s", fault)
            return fault
        return ""

    def crash_loop(self, service: str) -> str:
        """Describe a service that ends again and again; empty if it is stable."""
        with contextlib.suppress(FleetError):
            for row in self.info():
                if row.name == service and row.ends_lately >= _LOOPS:
                    return (
                        f"{service} is in a crash loop: it ended {row.ends_lately} times in the "
                        f"last minute, the last time with {row.last_exit}: {row.last_line}; its "
                        f"log is {self.run.log_of(service)}"
                    )
        return ""

    def restart_together(self, modules: Sequence[str]) -> None:
        """Restart joint services at the same moment; their next processes arm their drives.

        Raises:
            FleetError: a service has no process, or there is no supervisor to restart it. Nothing
                is changed then.
        """
        if fault := self.supervision_fault():
            raise FleetError(f"nothing was restarted: {fault}")
        pids = self.pids()
        if missing := [module for module in modules if module not in pids]:
            raise FleetError(f"nothing was restarted: no process for {', '.join(missing)}")
        rearm_guard.clear(self.run.path, *modules)
        procfs.signal_all([pids[module] for module in modules], signal.SIGKILL)

    def start_service(self, service: str) -> int | None:
        """Start a stopped service without waiting for a delayed restart; return None.

        If the service is running, return its process id and change nothing.

        Because a person requests it, a drive that lost torque is armed again
        (`services.joint.rearm_guard`). A suspended service is continued.
        """
        process_table.check_known([service], self.manifest.services)
        pid = self.pids().get(service)
        if pid is None:
            self.forget(service)
            with contextlib.suppress(RefusedError):  # this ends the wait of a backoff
                self._supervisor.call("supervisor.stopProcess", service)
            try:
                self._supervisor.call("supervisor.startProcess", service, False)
            except RefusedError as refusal:
                raise FleetError(f"{service}: cannot start: {refusal}") from None
        elif procfs.is_suspended(pid):
            os.kill(pid, signal.SIGCONT)
        else:
            return pid
        return None

    def stop(self, *, keep_logs: bool = False, keep_stops: bool = False) -> None:
        """Stop every service and the supervisor, and remove their files.

        Each service, even a suspended one, first gets its stop signal, then SIGKILL after its
        timeout. Without a fleet this does nothing. Only foreign files, temperatures and requested
        logs remain in the run directory; with `keep_stops` an emergency stop remains too.
        """
        self._end()
        if not self.run.is_marked:
            return  # there never was a fleet: no file here is a fleet's
        try:
            lock = self.run.claim(alone=False)
        except FleetError:
            return  # the next fleet is already starting here, and has cleaned up
        try:
            self._clear(keep_logs=keep_logs, keep_stops=keep_stops)
        finally:
            os.close(lock)

    def _start(self, plan: FleetPlan, lock: int, clock_pace: float) -> None:
        disarmed = plan.options.disarmed
        try:
            process_table.check_free(plan.listeners)
            with private_files():
                self.run.prepare(plan, clock_pace)
            environment = dict(plan.environment)
            if plan.emulated_usb:
                environment |= usb_standin.prepare(self.run.path)
            self._launch(environment, lock, leashed=plan.options.leashed)
            try:
                self._wait_until_up(plan)
            except FleetError as error:
                if not (disarmed and self._is_supervised):
                    raise
                log.get("xrl").warning("the supervisor keeps trying: %s", error)
        except BaseException as error:
            with _uninterrupted():
                self._end()
                self._clear(keep_logs=isinstance(error, FleetError), keep_stops=disarmed)
            raise

    @property
    def _is_supervised(self) -> bool:
        """True while the supervisor that this process started is alive."""
        return self._process is not None and self._process.poll() is None

    def _end_unsupervised(self, *, take_over: bool) -> None:
        """End services that a dead supervisor left here; their drives keep holding."""
        left = procfs.fleet_pids(self.run.path)
        if not left:
            return
        if not take_over:
            raise FleetError(
                f"{self.run.path}: a fleet without a supervisor runs here (processes: {len(left)}"
                "); `xrl down` lowers the robot and ends the processes"
            )
        procfs.signal_all(left, signal.SIGCONT)
        procfs.signal_all(left, signal.SIGTERM)  # leaves the drives holding
        self._wait_or_kill(_KILLED_S)

    def _clear(self, *, keep_logs: bool, keep_stops: bool) -> None:
        usb_standin.clear(self.run.path)
        self.run.clear(keep_logs=keep_logs, keep_stops=keep_stops)

    def _end(self) -> None:
        manifest = self.run.read_manifest()
        procfs.signal_all(procfs.fleet_pids(self.run.path), signal.SIGCONT)
        try:
            if manifest is None:
                raise _not_up(self.run)
            self._supervisor.call("supervisor.stopAllProcesses", False)  # all at once, because
            self._supervisor.call("supervisor.shutdown")  # this alone stops one after the other
        except FleetError:
            # no supervisor answers: the processes are signalled directly
            # (after SIGINT a joint service leaves its drive idle)
            procfs.signal_all(procfs.fleet_pids(self.run.path), signal.SIGINT)
        patience_s = (manifest.stop_s if manifest else 0.0) + 2.0
        self._wait_or_kill(patience_s)

    def _wait_or_kill(self, patience_s: float) -> None:
        """Wait until every process of the fleet has ended; kill the rest after a timeout."""
        left = procfs.wait_until_gone(self.run.path, patience_s)
        if left:
            procfs.signal_all(left, signal.SIGKILL)
            left = procfs.wait_until_gone(self.run.path, _KILLED_S)
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_POLL_S)  # otherwise it stays a zombie of this process
        if left:
            raise FleetError(
                f"still running after SIGKILL: process {', '.join(map(str, sorted(left)))}"
            )

    def _launch(self, environment: Mapping[str, str], lock: int, *, leashed: bool) -> None:
        leash = ["--parent", str(os.getpid())] if leashed else []
        command = [sys.executable, "-m", "tools.fleet.supervisor_process", *leash, "--"]
        command += ["--nodaemon", "--configuration", str(self.run.supervisor_config)]
        # An interrupt between fork and exec would leave a process that cannot be found;
        # `tools.fleet.supervisor_process` unblocks in the child.
        with _uninterrupted(), private_files(), self.run.supervisor_stderr.open("wb") as output:
            self._process = subprocess.Popen(
                command,
                env={**os.environ, **environment, FLEET_VARIABLE: str(self.run.path)},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,  # Ctrl-C in the terminal is only for this process
                pass_fds=(lock,),
            )

    def _wait_until_up(self, plan: FleetPlan) -> None:
        endpoints = {  # the first of a service's endpoints, its socket
            item.service: item.endpoint
            for item in reversed(plan.listeners)
            if item.key.startswith("bus.")
        }
        waiting = {row.name: row for row in plan.processes if row.autostart}
        watched = tuple(waiting)
        watch = _ProgressWatch(plan.options.timeout_s, self._used_s)
        while waiting:
            time.sleep(_POLL_S)
            for service in self._info_or_none():
                failed = service.state in _FAILED or service.restarts > 0
                if failed and service.name in watched:
                    raise FleetError(self._first_end(service))
                row = waiting.get(service.name)
                if row is not None and _is_up(row, service, endpoints.get(row.name)):
                    del waiting[row.name]
            if waiting and (given_up := watch.look(waiting)):
                log = self.run.log_of(next(iter(waiting)))
                words = f"{given_up}: {', '.join(waiting)}; {log}:"
                raise FleetError(f"{words}\n{_tail(log)}".rstrip())

    def _used_s(self, services: Collection[str]) -> float:
        """Return the CPU time of these services, or of their supervisor if none has a process."""
        pids = [pid for name, pid in self.pids().items() if name in services]
        if not pids and self._process is not None:
            pids = [self._process.pid]
        return sum(procfs.cpu_s_of(pids).values())

    def _info_or_none(self) -> list[ServiceInfo]:
        """Return every service; empty while the supervisor is still starting."""
        if self._process is not None and self._process.poll() is not None:
            words = _tail(self.run.supervisor_stderr) or _tail(self.run.supervisor_log)
            raise FleetError(f"supervisord has ended while starting\n{words}".rstrip())
        if not self.run.supervisor_socket.exists():
            return []
        try:
            return self.info()
        except FleetError:
            return []

    def _first_end(self, service: ServiceInfo) -> str:
        """Describe a service that ended while the fleet was starting."""
        log = self.run.log_of(service.name)
        how = service.last_exit or "could not be run"
        words = _tail(log) or service.last_line
        return f"{service.name} ended at once ({how}); {log}:\n{words}".rstrip()


class _ProgressWatch:
    """Distinguishes a slow start on a busy machine from a start that is stuck.

    A service that comes up is progress, and so is CPU time that the others use: their imports
    take seconds of it.
    """

    def __init__(self, timeout_s: float, used_s: Callable[[Collection[str]], float]) -> None:
        self._timeout_s, self._used_s = timeout_s, used_s
        self._begun_s = self._moved_s = self._looked_s = time.monotonic()
        self._seen: tuple[int, float] = (0, 0.0)

    def look(self, waiting: Collection[str]) -> str:
        """Return why the start has failed, or "" while it makes progress."""
        now_s = time.monotonic()
        if now_s - self._looked_s >= _LOOK_S:
            self._looked_s = now_s
            seen = (len(waiting), self._used_s(waiting))
            if seen[0] != self._seen[0] or abs(seen[1] - self._seen[1]) >= _USED_S:
                self._seen, self._moved_s = seen, now_s
        if now_s - self._moved_s > self._timeout_s:
            return f"not up, and no progress for {self._timeout_s:g} s"
        if now_s - self._begun_s > START_MAX_S:
            return f"not up after {START_MAX_S:g} s"
        return ""


def _not_up(run: RunDir, why: str = "") -> FleetError:
    return FleetError(f"no fleet is up in {run.path}; `xrl up` starts one{why}")


def _unsupervised(name: str, pid: int | None) -> ServiceInfo:
    """Return the kernel's information about a service whose supervisor is dead."""
    if pid is None:
        return ServiceInfo(name, None, "gone", 0.0)
    state = "suspended" if procfs.is_suspended(pid) else "unsupervised"
    return ServiceInfo(name, pid, state, procfs.uptime_s(pid))


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _INTERRUPTS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _is_up(row: Process, service: ServiceInfo, endpoint: str | None) -> bool:
    if row.ready == "running" or endpoint is None:
        return service.state == "running"
    return service.pid is not None and process_table.is_listening(endpoint)


def _tail(log: Path) -> str:
    with contextlib.suppress(OSError):
        text = log.read_text(encoding="utf-8", errors="replace").rstrip()
        return "\n".join(f"  {line}" for line in text.splitlines()[-5:])
    return ""
