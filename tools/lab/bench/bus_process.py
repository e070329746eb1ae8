"""One process of the fleet's pattern: `-m tools.lab.bench.bus_process TRANSPORT NAME FOLDER`.

A module publishes its state in every other cycle and takes the newest command in each. The planner
publishes six commands once six new states are there. Encoding, rates, polling and priorities are
the services' own; laws and drives are absent. Prints one JSON object, `BusReport`.
"""

from __future__ import annotations

import gc
import sys
import time
from pathlib import Path
from typing import Final

import msgspec

from shared import scheduling
from shared.arguments import FlagParser
from shared.bus.codec import Decoder, encode
from shared.bus.messages import JointCommand, JointState
from shared.clock import NS_PER_S, NS_PER_US
from shared.joints import MODULES
from tools.lab.bench.transports import Transport, installed

CYCLE_HZ: Final = 500.0
TICK_HZ: Final = 250.0
STATE_EVERY: Final = 2
POLL_NS: Final = 400 * NS_PER_US
REST_FRACTION: Final = 0.8
"""Fraction of a period before the planner polls again; then it polls every `POLL_NS`."""
WARM_UP_S: Final = 1.5
"""Time until all links are there; nothing of it is counted."""
_PRIORITY: Final = 20
PLANNER: Final = "planner"


class BusReport(msgspec.Struct):
    """What one process saw after the warm-up."""

    name: str
    cpu_s: float = 0.0
    """CPU time of all its threads."""
    wall_s: float = 0.0
    latency_us: list[float] = []
    """Time of each command from the planner's put to the module's take."""
    missed: int = 0
    """Commands that one cycle could have taken, and a later one took."""
    lost: int = 0
    """Commands whose numbers were skipped."""


class _Measured:
    """CPU and wall time since the warm-up's end."""

    def __init__(self, seconds: float) -> None:
        self.begin_ns = time.monotonic_ns() + round(WARM_UP_S * NS_PER_S)
        self.end_ns = self.begin_ns + round(seconds * NS_PER_S)
        self._cpu_s: float | None = None

    def has_begun(self, now_ns: int) -> bool:
        """Return True after the warm-up."""
        if now_ns >= self.begin_ns and self._cpu_s is None:
            self._cpu_s = time.process_time()
        return self._cpu_s is not None

    def finish(self, report: BusReport) -> BusReport:
        """Return a report with the times."""
        report.cpu_s = time.process_time() - (self._cpu_s or 0.0)
        report.wall_s = (time.monotonic_ns() - self.begin_ns) / NS_PER_S
        return report


def run_module(transport: Transport, name: str, seconds: float) -> BusReport:
    """Run a module's cycles."""
    put, take = transport.publisher(f"state/{name}"), transport.latest(f"command/{name}")
    decoder, report, times = Decoder(JointCommand), BusReport(name), _Measured(seconds)
    period_ns = round(NS_PER_S / CYCLE_HZ)
    due, before_ns, cycles, seq, last_seq = time.monotonic_ns(), 0, 0, 0, -1
    while due < times.end_ns:
        now = time.monotonic_ns()
        payload = take()
        command = decoder.decode(payload) if payload is not None else None
        counts = times.has_begun(now)
        if command is not None:
            if counts:
                report.latency_us.append((now - command.t_ns) * 1e-3)
                report.missed += command.t_ns < before_ns
                report.lost += command.seq - last_seq - 1 if last_seq >= 0 else 0
            last_seq = command.seq
        cycles += counts
        if cycles % STATE_EVERY == 0 or not counts:
            seq += 1
            put(encode(msgspec.structs.replace(_STATE, t_ns=now, seq=seq)))
        before_ns = now
        due = _sleep_until(due + period_ns)
    return times.finish(report)


def run_planner(transport: Transport, name: str, seconds: float) -> BusReport:
    """Run the planner's ticks."""
    takes = [transport.latest(f"state/{module}") for module in MODULES]
    puts = [transport.publisher(f"command/{module}") for module in MODULES]
    decoder, times = Decoder(JointState), _Measured(seconds)
    period_ns = round(NS_PER_S / TICK_HZ)
    fresh, last_ns, seq = [False] * len(MODULES), 0, 0
    while (now := time.monotonic_ns()) < times.end_ns:
        for index, take in enumerate(takes):
            payload = take()
            if payload is not None and decoder.decode(payload) is not None:
                fresh[index] = True
        times.has_begun(now)
        if not all(fresh) and now - last_ns < 1.25 * period_ns:
            _sleep_until(now + POLL_NS)
            continue
        seq += 1
        for put in puts:
            put(encode(msgspec.structs.replace(_COMMAND, t_ns=time.monotonic_ns(), seq=seq)))
        fresh, last_ns = [False] * len(MODULES), now
        _sleep_until(now + round(REST_FRACTION * period_ns))
    return times.finish(BusReport(name))


def _sleep_until(due_ns: int) -> int:
    """Sleep until a time; return it, or now if that is a cycle later."""
    left_ns = due_ns - time.monotonic_ns()
    if left_ns > 0:
        time.sleep(left_ns / NS_PER_S)
        return due_ns
    return due_ns - left_ns if -left_ns > NS_PER_S / CYCLE_HZ else due_ns


_STATE: Final = JointState(
    t_ns=0, seq=0, q=(0.012345678901, -0.61234567890123), v=(0.0012345678901, 0.31234567890123),
    tau=(12.3456789012345, -45.678901234567), mode=2, cause=9, ready=True, age_ns=4_123_456,
    session=123_456_789, command_seq=12_345, cycle=123_456, late=3, dropouts=0, refused=0,
    drive=3, drive_error=0, stiffened=False, outside=0,
)  # fmt: skip
_PAIR: Final = (123.45678901234567, -0.61234567890123456)
_COMMAND: Final = JointCommand(
    t_ns=0, seq=0, session=123_456_789, echo_t_ns=123_456_789_012_345, hold=False, q_ref=_PAIR,
    v_ref=_PAIR, tau_ff=_PAIR, dtau_ff=_PAIR, tau_coupled=_PAIR, k_p=_PAIR, k_d=_PAIR, margin=0.25,
    margin_onboard=0.125,
)  # fmt: skip
"""Messages as long as the fleet's."""


def main() -> int:
    """Run one process and print its report."""
    parser = FlagParser(description=__doc__)
    parser.add_argument("transport")
    parser.add_argument("name")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=10.0)
    arguments = parser.parse_args()
    scheduling.raise_priority(_PRIORITY)
    transport = installed()[arguments.transport].join(arguments.name, arguments.folder)
    gc.freeze()
    gc.disable()
    run = run_planner if arguments.name == PLANNER else run_module
    report = run(transport, arguments.name, arguments.seconds)
    transport.close()
    sys.stdout.write(msgspec.json.encode(report).decode() + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
