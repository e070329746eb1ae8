"""Leads a live run through its scenario: start, kills, restarts, end.

It receives the simulated truth from the bus and acts by scenario time. It publishes each action as
a run event for the log, except impairments, which the network proxy publishes.
"""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from shared import scheduling
from shared.bus import topics
from shared.bus.messages import (
    JointState,
    Mode,
    PlannerStatus,
    RunEvent,
    RunEventKind,
    SimControl,
    name_of,
)
from shared.bus.pubsub import Latest
from shared.bus.session import Session
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S, machine_s, now_ns, pace
from shared.config.scenarios import Fault, Inject, Kill, Push, Restart, Scenario
from shared.exceptions import RunError
from shared.joints import MODULES
from tools.fleet import procfs
from tools.fleet.pace import IDLE_LEAST, PACE_MIN, CoresFullError, idle_and_total, idle_share
from tools.fleet.proxy_client import ProxyClient
from tools.fleet.stalls import Stall, StallWatch
from tools.fleet.supervise import SupervisedFleet

READY_TIMEOUT_S: Final = 45.0
"""Timeout for all modules to track, s: longer than a planner waits after five dropouts, because the
machine may stall."""
PATIENCE_S: Final = 10.0
"""Time for the start, which uses all cores, s. If the robot does not stand by then, the idle
fraction is measured over the same time again."""
SETTLE_S: Final = 2.0
"""Time for which all six modules must track before the scenario starts, s."""
AFTER_FALL_S: Final = 1.0
"""Time from a fall to the end of the run, s."""
SILENT_S: Final = 3.0
"""Timeout for the simulator's messages, s; after it the run ends with an error."""
LAST_WORDS_S: Final = 0.3
"""Time in which the last messages reach the recorder, s."""
POLL_S: Final = 0.004
UNHEARD_S: Final = 0.5
"""A module is shown as silent after this time without a message, s."""
PIDS_EVERY_S: Final = 1.0
STARTING: Final = "waiting for six modules to track"
FULL_CORE: Final = 0.2
"""Idle fraction below which one of two cores may be full."""
ENDING_S: Final = 3.0
"""Timeout for a service to end after TERM or INT, s."""


class LiveSnapshot(NamedTuple):
    """Contents of the live display."""

    truth: SimTruth | None
    modes: tuple[str, ...]
    """First letter of each module's mode; `-` for a silent module."""
    note: str


class EndOfRun(NamedTuple):
    """Result of a run."""

    cpu_pct: float | None
    """CPU use of all processes together, %: 100 is one core; None if the robot fell before the
    scenario could start."""
    scenario_s: float
    """Scenario time until which the robot had to stand."""


class TriggeredKill(NamedTuple):
    """A kill without a fixed time: it comes when modules track again after a dropout."""

    service: str
    modules: int
    """Number of modules that must track again."""
    after_s: float
    """Time from then to the kill, s."""


class _CpuMeter:
    """CPU time of the fleet and of this process, summed over processes that come and go."""

    def __init__(self) -> None:
        self._last: dict[int, float] = {}
        self._begin_s = self._end_s = time.monotonic()
        self._spent_s = 0.0

    def sample(self, pids: Iterable[int]) -> None:
        """Add the time that each process has used since the previous sample."""
        self._end_s = time.monotonic()
        for pid, cpu_s in procfs.cpu_s_of((*pids, os.getpid())).items():
            self._spent_s += cpu_s - self._last.get(pid, cpu_s)
            self._last[pid] = cpu_s

    @property
    def share_pct(self) -> float:
        """Mean use from the first sample to the last: 100 is one core."""
        return 100.0 * self._spent_s / max(1e-9, self._end_s - self._begin_s)


class _ArmedKill:
    """A triggered kill that is still pending."""

    def __init__(self, kill: TriggeredKill | None) -> None:
        self._kill = kill
        self._dropped_out = False
        self._at_s = math.inf

    def due(self, tracking: int) -> str | None:
        """Return the service to kill, once, when its time has come."""
        kill, now_s = self._kill, time.monotonic()
        if kill is None:
            return None
        self._dropped_out |= tracking == 0
        if self._dropped_out and tracking >= kill.modules:
            self._at_s = min(self._at_s, now_s + machine_s(kill.after_s))
        if now_s < self._at_s:
            return None
        self._kill = None
        return kill.service


class _RunEvents:
    """Publishes the actions on the run, and stalls, so that the log shows them."""

    def __init__(self, session: Session) -> None:
        self._publisher = session.publisher(topics.RUN_EVENT, RunEvent)
        self.said: list[RunEvent] = []
        self.start_ns = 0
        """Time zero of the scenario on the fleet's clock; 0 before it starts."""

    def say(self, kind: RunEventKind, subject: str, detail: str) -> None:
        now = now_ns()
        self._publish(
            RunEvent(
                t_ns=now,
                seq=len(self.said) + 1,
                kind=int(kind),
                subject=subject,
                detail=detail,
                scenario_s=(now - self.start_ns) / NS_PER_S,
            )
        )

    def tell(self, stalls: Iterable[Stall]) -> None:
        for stall in stalls:
            zero_ns = self.start_ns or stall.begin_ns + NS_PER_S
            self._publish(stall.event(len(self.said) + 1, zero_ns))

    def _publish(self, event: RunEvent) -> None:
        self.said.append(event)
        self._publisher.put(event)


class ScenarioRunner:
    """One live run."""

    def __init__(
        self,
        fleet: SupervisedFleet,
        session: Session,
        scenario: Scenario,
        show: Callable[[LiveSnapshot], None],
        triggered_kill: TriggeredKill | None = None,
        tell: Callable[[str], None] = lambda _text: None,
    ) -> None:
        """Subscribe; `tell` receives the description of the machine before the start."""
        self._fleet = fleet
        self._scenario = scenario
        self._show = show
        self._tell = tell
        self._armed = _ArmedKill(triggered_kill)
        self._events = _RunEvents(session)
        self._truths: Latest[SimTruth] = session.latest(topics.SIM_TRUTH, SimTruth)
        # a triggered kill needs the newest modes; a batch is up to 20 ms old
        subscribe = session.latest_in_batch if triggered_kill is None else session.latest
        self._states = {m: subscribe(topics.JOINT_STATE, JointState, m) for m in MODULES}
        self._planner: Latest[PlannerStatus] = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        self._control = session.publisher(topics.SIM_CONTROL, SimControl)
        self._truth: SimTruth | None = None
        self._truth_at_s = time.monotonic()
        self._modes: dict[str, int] = {}
        self._heard_s: dict[str, float] = {}
        self._note = ""
        self._pids: dict[str, int] = {}
        self._next_pids_s = 0.0
        self._stalls = StallWatch()
        self._killed = False

    def run(self, is_over: Callable[[], bool] = lambda: False) -> EndOfRun:
        """Wait until the robot stands; then run the scenario to its end, or until `is_over`.

        Raises:
            CoresFullError: the cores are too slow for the fleet at its pace.
            RunError: the robot did not stand in time, or the simulator restarted or fell silent.
            FleetError: a service could not be restarted.
        """
        with self._stalls:
            return self._run(is_over)

    @property
    def said(self) -> list[RunEvent]:
        """The actions and stalls until now."""
        return self._events.said

    def _run(self, is_over: Callable[[], bool]) -> EndOfRun:
        rows = self._scenario
        if not self._wait_until_tracking(is_over):
            self._finish("fell before the start")
            return EndOfRun(None, rows.duration)
        self._start()
        todo: list[Kill | Restart | Push | Fault | Inject] = [
            *rows.kill, *rows.restart, *rows.push, *rows.fault, *rows.inject,
        ]  # fmt: skip
        todo.sort(key=lambda row: row.at)
        fallen_at_s, ended_at_s = math.inf, rows.duration
        meter = _CpuMeter()
        while True:
            self._listen()
            self._sample_processes(meter)
            truth = self._truth
            if truth is not None and truth.scenario_s < 0.0:
                raise RunError("the simulator has restarted, and its scenario is lost; see its log")
            if truth is not None:
                # between two such messages the scenario's clock advances with this process's clock
                self._events.start_ns = _zero_ns(truth)
                if truth.fallen and truth.scenario_s < fallen_at_s:
                    fallen_at_s, self._note = truth.scenario_s, "FALLEN"
                if truth.scenario_s >= min(rows.duration, fallen_at_s + AFTER_FALL_S):
                    break
                if is_over():
                    ended_at_s = truth.scenario_s
                    break
            scenario_s = (now_ns() - self._events.start_ns) / NS_PER_S
            while todo and scenario_s >= todo[0].at:
                self._act(todo.pop(0))
            self._follow(scenario_s)
            time.sleep(POLL_S)
        meter.sample(self._pids.values())
        self._finish("")
        return EndOfRun(meter.share_pct, ended_at_s)

    def _finish(self, detail: str) -> None:
        self._events.say(RunEventKind.FINISHED, self._scenario.name, detail)
        time.sleep(LAST_WORDS_S)

    def _sample_processes(self, meter: _CpuMeter) -> None:
        """Read the process ids once a second, so that a kill needs no search in /proc."""
        now_s = time.monotonic()
        if now_s >= self._next_pids_s:
            self._next_pids_s = now_s + PIDS_EVERY_S
            self._pids = self._fleet.pids()
            meter.sample(self._pids.values())

    def _wait_until_tracking(self, is_over: Callable[[], bool]) -> bool:
        """Wait until the hoist is down and all six modules have tracked for `SETTLE_S`.

        Meanwhile the idle fraction of the cores shows whether the cores suffice.
        Return False if the robot falls first, which is a result and not an error.
        """
        begin_s = time.monotonic()
        deadline, look_s = begin_s + machine_s(READY_TIMEOUT_S), begin_s + PATIENCE_S
        since = before = None
        self._note = STARTING
        while since is None or time.monotonic() - since < machine_s(SETTLE_S):
            self._listen()
            if is_over():
                raise KeyboardInterrupt
            tracking = [self._modes.get(module) == Mode.TRACK for module in MODULES]
            standing = self._truth is not None and self._truth.hoist == 0.0
            if self._truth is not None and self._truth.fallen:
                return False
            if all(tracking) and standing:
                if since is None:
                    since, before = time.monotonic(), idle_and_total()
                self._note = "standing, settling"
            else:
                since = None
                if time.monotonic() >= look_s:
                    if before is not None:
                        self._check_cores(idle_share(before))
                    before, look_s = idle_and_total(), time.monotonic() + PATIENCE_S
            if time.monotonic() > deadline:
                lead = self._planner.take()
                raise RunError(
                    f"not all six modules track after {READY_TIMEOUT_S:.0f} s: "
                    f"{(lead.why if lead else '') or self._describe_modes()}; "
                    "see the services' logs"
                )
            time.sleep(POLL_S)
        assert before is not None  # noqa: S101 - set with `since`
        idle = idle_share(before)
        self._check_cores(idle)
        self._tell(describe_machine(idle))
        self._note = ""
        return True

    def _check_cores(self, idle: float) -> None:
        """Raise CoresFullError if the idle fraction of the cores is too small."""
        if idle < IDLE_LEAST:
            half = max(PACE_MIN, pace() / 2)
            remedy = f"add `--pace {half:g}`" if half < pace() else "end other programs"
            raise CoresFullError(
                f"the cores are too slow for the fleet at a pace of {pace():g}: "
                f"{100 * idle:.0f} % idle; modules: {self._describe_modes()}; {remedy}"
            )

    def _describe_modes(self) -> str:
        return ", ".join(
            f"{module} {name_of(Mode, self._modes[module]) if module in self._modes else 'silent'}"
            for module in MODULES
        )

    def _start(self) -> None:
        """Request the start from the simulator until the scenario has started."""
        asked, deadline = 0, time.monotonic() + 5.0
        while self._truth is None or self._truth.scenario_s < 0.0:
            asked += 1
            self._control.put(SimControl(t_ns=now_ns(), seq=asked, start=True))
            time.sleep(0.05)
            self._listen()
            if time.monotonic() > deadline:
                raise RunError("the simulator does not start the scenario; see its log")
        self._events.start_ns = _zero_ns(self._truth)
        self._events.say(RunEventKind.STARTED, self._scenario.name, "")

    def _listen(self) -> None:
        for module, latest in self._states.items():
            state = latest.take()
            if state is not None:
                self._modes[module] = state.mode
                self._heard_s[module] = time.monotonic()
            elif time.monotonic() - self._heard_s.get(module, 0.0) > UNHEARD_S:
                self._modes.pop(module, None)
        truth = self._truths.take()
        if truth is not None:
            self._truth, self._truth_at_s = truth, time.monotonic()
            modes = tuple(
                name_of(Mode, self._modes[module])[0] if module in self._modes else "-"
                for module in MODULES
            )
            note = "; ".join(word for word in (self._note, self._stall_words()) if word)
            self._show(LiveSnapshot(truth, modes, note))
        elif time.monotonic() - self._truth_at_s > SILENT_S and self._events.start_ns:
            raise RunError(f"the simulator has been silent for {SILENT_S:.0f} s; see its log")
        stalls = self._stalls.take()
        self._stalls.note_held(list(self._modes.values()).count(Mode.HOLD))
        if self._note == STARTING:  # starting services load the machine, and the modules hold
            self._stalls.longest = Stall(0, 0)
        else:
            self._events.tell(stalls)

    def _stall_words(self) -> str:
        """Describe the longest recent stall; empty if there was none."""
        stalls = self._stalls
        if not stalls.is_recent(now_ns()) or self._note == STARTING:
            return ""
        who = "all six" if stalls.held == len(MODULES) else stalls.held
        by_it = f": {who} held" if stalls.held and not self._killed else ""
        return f"{stalls.longest.words}{by_it}"

    def _act(self, row: Kill | Restart | Push | Fault | Inject) -> None:
        """Carry out a due action; the simulator does pushes and faults, which are only recorded."""
        if isinstance(row, Kill):
            self._events.say(RunEventKind.KILLED, row.service, row.signal)
            self._killed = True
            number = signal.Signals[f"SIG{row.signal}"]
            try:
                os.kill(self._pids[row.service], number)
            except (KeyError, ProcessLookupError):
                words = f"kill {row.service}@{row.at:g}: the service has no process at that time"
                raise RunError(f"{words}; see logs/{row.service}.log") from None
            self._note = f"{row.service} {'stopped' if row.signal == 'STOP' else 'killed'}"
        elif isinstance(row, Restart):
            self._wait_until_ended(row.service)
            self._events.say(RunEventKind.RESTARTED, row.service, "")
            self._fleet.start_service(row.service)
            self._next_pids_s = 0.0
            self._note = f"{row.service} back"
        elif isinstance(row, Inject):
            ProxyClient(self._fleet.run.path).begin(row)
        elif isinstance(row, Fault):
            self._events.say(RunEventKind.FAULTED, row.module, row.kind)
            self._note = f"{row.module}: {row.kind}"
        else:
            x, y, z = row.force
            self._events.say(
                RunEventKind.PUSHED, "torso", f"{x:g},{y:g},{z:g} N for {row.duration:g} s"
            )

    def _follow(self, scenario_s: float) -> None:
        service = self._armed.due(list(self._modes.values()).count(Mode.TRACK))
        if service is not None:
            self._act(Kill(service=service, at=scenario_s))

    def _wait_until_ended(self, service: str) -> None:
        """Wait until a service has ended after TERM or INT, but not for a suspended one."""
        pid = self._pids.get(service)
        deadline = time.monotonic() + ENDING_S
        while pid is not None and time.monotonic() < deadline:
            if procfs.is_gone(pid) or procfs.is_suspended(pid):
                return
            time.sleep(POLL_S)


def describe_machine(idle: float) -> str:
    """Describe the load of the machine, from the idle fraction of its cores."""
    words = f"{len(os.sched_getaffinity(0))} cores, {100 * idle:.0f} % idle beside the fleet"
    pause_ms = scheduling.real_time_pause_ms() if idle < FULL_CORE else 0.0
    if pause_ms:
        words += (
            f"; the kernel stops a core that is full of real-time work for {pause_ms:g} ms in "
            f"each second; to prevent that, run `sudo sysctl {scheduling.NO_PAUSE}`"
        )
    return words


def _zero_ns(truth: SimTruth) -> int:
    """Return the time zero of the scenario on the fleet's clock."""
    return truth.t_ns - round(truth.scenario_s * NS_PER_S)
