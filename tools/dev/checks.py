"""What `./deploy/test` runs once the environment is there: lint, types, a test of every claim."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, Final, NamedTuple

import msgspec

from shared.exceptions import FAULT_EXIT_CODE

CHECKS: Final = (("ruff", "check"), ("ruff", "format", "--check"), ("mypy",))
PYTEST: Final = ("pytest", "--durations=12", "--durations-min=2")
CORES: Final = os.cpu_count() or 1
LIVE: Final = (*PYTEST, "-m", "live and not wide", "tests/system")
"""None is elsewhere: tests/test_architecture.py."""
WAITING: Final = (
    *PYTEST, "-m", "system and not live", "--numprocesses", str(2 * CORES), "--dist", "loadfile",
)  # fmt: skip
"""They wait, mostly. `_everything` adds the files in which the mark stands."""
PATIENT: Final = (
    (
        *PYTEST, "-m", "not system and not wide", "--numprocesses", "auto", "--dist", "loadfile",
        "--no-loadscope-reorder", "--timeout", "300",
    ),
    ("python", "-m", "tools.dev.mutants", "--sample"),
)  # fmt: skip
"""Neither processes nor real time: they take what the others leave of the cores, and longer."""


class Plan(NamedTuple):
    """Commands after lint and types."""

    alone: tuple[tuple[str, ...], ...] = ()
    beside: tuple[tuple[str, ...], ...] = ()
    """Begun before these, and followed after them."""


INTERRUPTED: Final = 128 + signal.SIGINT
ENDS_BY: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""The first is ignored where a shell put us behind."""
ENDS_IN_S: Final = 30.0
"""Time for a part to end after Ctrl-C: a fleet goes down."""
LOOK_EVERY_S: Final = 0.2
SHOWN: Final = 9
"""Words of a command."""


class Check(msgspec.Struct):
    """A command, and what came of it."""

    command: tuple[str, ...]
    process: subprocess.Popen[bytes]
    begun_s: float
    said: bytes = b""
    status: int = 0
    took_s: float = 0.0

    @property
    def name(self) -> str:
        """The command as a person would write it."""
        words = [word for word in self.command if not word.startswith("--durations")]
        if len(words) > SHOWN:
            words = [*words[:SHOWN], "..."]
        return " ".join(f"'{word}'" if " " in word else word for word in words)

    @property
    def is_pytest(self) -> bool:
        """True if its last line is a count."""
        return self.command[0] == "pytest"

    @property
    def lines(self) -> list[str]:
        """What it said."""
        return self.said.decode(errors="replace").splitlines()

    @property
    def outcome(self) -> str:
        """The last line's words for it."""
        if self.is_pytest and self.lines:
            return f"{self.lines[-1].strip('= ')} ({self.name})"
        return f"{self.name}, {self.took_s:.0f} s"

    @property
    def failures(self) -> list[str]:
        """What failed, a line each."""
        if not self.status:
            return []
        last = f": {self.lines[-1]}" if self.is_pytest and self.lines else ""
        return [self.name + last, *(w for w in self.lines if w.startswith(("FAILED ", "ERROR ")))]


def main(argv: Sequence[str]) -> int:
    """Run all parts, or lint, types and the tests that pytest's arguments name; 0, 3 or 130."""
    for number in ENDS_BY:
        signal.signal(number, signal.default_int_handler)
    begun_s = time.monotonic()
    plan = Plan((PYTEST + tuple(argv),)) if argv else _everything()
    running: list[Check] = []
    with ExitStack() as stack:
        stack.callback(_stop, running)
        beside = list[tuple[Check, IO[bytes]]]()
        try:
            for command in plan.beside:
                to = stack.enter_context(tempfile.TemporaryFile())
                beside.append((_start(command, to, beside=True), to))
                running.append(beside[-1][0])
                print(f"== beside the others, shown after them: {running[-1].name}", flush=True)
            done = [_run(command, running) for command in (*CHECKS, *plan.alone)]
            done += [_follow(*each, running) for each in beside]
        except KeyboardInterrupt:
            return INTERRUPTED
        except BrokenPipeError:  # nobody reads it any more: `| head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 128 + signal.SIGPIPE
    return _tell(done, time.monotonic() - begun_s)


def _everything() -> Plan:
    """Return all parts.

    Each worker of the waiting tests would import every test there is: it is given the files with
    their mark (tests/conftest.py sees to it that it stands there).
    """
    files = sorted(Path("tests").rglob("test_*.py"))
    marked = [str(file) for file in files if "pytest.mark.system" in file.read_text("utf-8")]
    return Plan((LIVE, (*WAITING, *marked)), beside=PATIENT)


def _start(command: tuple[str, ...], to: IO[bytes] | int, *, beside: bool = False) -> Check:
    """Start a part in a process group of its own: it gets one SIGINT, whoever was sent how many."""
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=to,
        stderr=subprocess.STDOUT,
        process_group=0,
        preexec_fn=_give_way if beside else None,  # noqa: PLW1509 - there is no thread
    )
    return Check(command, process, time.monotonic())


def _give_way() -> None:
    """Run while a core is idle: Linux's idle class gives way at once, niceness does not."""
    os.nice(19)
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def _run(command: tuple[str, ...], running: list[Check]) -> Check:
    """Run a part to its end, and show what it says as it says it."""
    pipe, end = os.pipe()
    part = _start(command, end)
    os.close(end)
    running.append(part)
    print(f"== {part.name}", flush=True)
    while piece := os.read(pipe, 1 << 16):
        _show(piece, part)
    os.close(pipe)
    return _ended(part, running)


def _follow(part: Check, said: IO[bytes], running: list[Check]) -> Check:
    """Show what one beside the others has said, and says, to its end."""
    print(f"== {part.name}", flush=True)
    at, goes_on = 0, True
    while goes_on:
        goes_on = part.process.poll() is None
        while piece := os.pread(said.fileno(), 1 << 16, at):
            at += len(piece)
            _show(piece, part)
        time.sleep(LOOK_EVERY_S if goes_on else 0.0)
    return _ended(part, running)


def _show(piece: bytes, part: Check) -> None:
    sys.stdout.buffer.write(piece)
    sys.stdout.buffer.flush()
    part.said += piece


def _ended(part: Check, running: list[Check]) -> Check:
    """Take the outcome of a part that has said all it says."""
    part.status = part.process.wait()
    part.took_s = time.monotonic() - part.begun_s
    running.remove(part)
    if part.status:
        print(f"== FAILED: {part.name}", flush=True)
    return part


def _stop(running: list[Check]) -> None:
    """End what still runs, as Ctrl-C in its own terminal would."""
    for part in running:
        with suppress(ProcessLookupError):
            os.killpg(part.process.pid, signal.SIGINT)
    until_s = time.monotonic() + ENDS_IN_S
    for part in running:
        with suppress(subprocess.TimeoutExpired):
            part.process.wait(max(0.0, until_s - time.monotonic()))
        with suppress(ProcessLookupError):
            os.killpg(part.process.pid, signal.SIGKILL)


def _tell(done: list[Check], took_s: float) -> int:
    """Print what failed, then the last line; return the exit code."""
    failures = [line for part in done for line in part.failures]
    for line in failures:
        print(f"== failed: {line}")
    skips: Counter[str] = Counter()
    for part in done:
        for line in part.lines:
            if row := re.match(r"SKIPPED \[(\d+)\] [^ ]+: (.*)", line):
                skips[row[2]] += int(row[1])
    minutes, seconds = divmod(round(took_s), 60)
    parts = "; ".join(part.outcome for part in done)
    skipped = "; ".join(f"{count}: {why}" for why, count in skips.items()) or "nothing"
    word = "FAILED" if failures else "passed"
    print(f"== {word} in {minutes} min {seconds} s: {parts}; skipped: {skipped}", flush=True)
    return FAULT_EXIT_CODE if failures else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
