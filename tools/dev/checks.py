"""Lint, types and tests: the parts of `./deploy/test`, in an existing environment."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from shared.exceptions import FAULT_EXIT_CODE

CHECKS: Final = (
    ("ruff", "check"),
    ("ruff", "format", "--check"),
    ("mypy",),
    ("python", "-m", "tools.dev.words"),
)
PYTEST: Final = ("pytest", "--durations=12", "--durations-min=2")
CORES: Final = os.cpu_count() or 1
LIVE: Final = (*PYTEST, "-m", "live and not wide", "tests/system")
"""Tests on live fleets, all in tests/system (tests/test_architecture.py checks that)."""
WAITING: Final = (
    *PYTEST, "-m", "system and not live", "--numprocesses", str(2 * CORES), "--dist", "loadfile",
)  # fmt: skip
"""Tests that mostly wait. `main` adds the files that contain the mark `system`."""
PATIENT: Final = (
    (
        *PYTEST, "-m", "not system and not wide", "--numprocesses", "auto", "--dist", "loadfile",
        "--no-loadscope-reorder", "--timeout", "300",
    ),
    ("python", "-m", "tools.dev.mutants", "--sample"),
)  # fmt: skip
"""Parts that do not depend on real time; they run while the other parts leave a core idle."""

INTERRUPTED: Final = 128 + signal.SIGINT
ENDS_BY: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end the run. Each needs a handler: a shell starts background jobs with SIGINT
ignored."""
ENDS_IN_S: Final = 30.0
"""Timeout for a part to end after Ctrl-C, s; it may have to stop a fleet first."""
LOOK_EVERY_S: Final = 0.1
SHOWN_WORDS: Final = 9


class Check:
    """A command, its output and its outcome."""

    def __init__(self, command: tuple[str, ...], *, beside: bool = False) -> None:
        """Start the command in a separate process group, so that only `_stop` sends it SIGINT."""
        words = [word for word in command if not word.startswith("--durations")]
        self.name = shlex.join(words[:SHOWN_WORDS]) + " ..." * (len(words) > SHOWN_WORDS)
        self._is_pytest = command[0] == "pytest"
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        self._begun_s, self.took_s = time.monotonic(), 0.0
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=self._said,
            stderr=subprocess.STDOUT,
            process_group=0,
            preexec_fn=_give_way if beside else None,  # noqa: PLW1509 - there is no thread
        )

    def follow(self) -> None:
        """Print the output of the command until it ends."""
        print(f"== {self.name}", flush=True)
        shown, goes_on = 0, True
        while goes_on:
            goes_on = self.process.poll() is None
            while piece := os.pread(self._said.fileno(), 1 << 16, shown):
                shown += len(piece)
                sys.stdout.buffer.write(piece)
                sys.stdout.buffer.flush()
            time.sleep(LOOK_EVERY_S if goes_on else 0.0)
        self.took_s = time.monotonic() - self._begun_s
        if self.process.returncode:
            print(f"== FAILED: {self.name}", flush=True)

    @property
    def lines(self) -> list[str]:
        """Lines of the output so far."""
        size = os.fstat(self._said.fileno()).st_size
        return os.pread(self._said.fileno(), size, 0).decode(errors="replace").splitlines()

    @property
    def outcome(self) -> str:
        """Test counts, or duration, for the summary."""
        if self._is_pytest and self.lines:
            return f"{self.lines[-1].strip('= ')} ({self.name})"
        return f"{self.name}, {self.took_s:.0f} s"

    @property
    def failures(self) -> list[str]:
        """A line for each failure."""
        if not self.process.returncode:
            return []
        last = f": {self.lines[-1]}" if self._is_pytest and self.lines else ""
        return [self.name + last, *(w for w in self.lines if w.startswith(("FAILED ", "ERROR ")))]


def main(argv: Sequence[str]) -> int:
    """Run all parts; with arguments for pytest, only lint, types and the tests that they select.

    Returns 0, or 3 if a part failed, 130 if interrupted, or 141 if the output pipe closed.
    """
    for number in ENDS_BY:
        signal.signal(number, signal.default_int_handler)
    begun_s = time.monotonic()
    # pass only the files with the mark, because each worker would import all others too
    marked = [
        str(file)
        for file in sorted(Path("tests").rglob("test_*.py"))
        if "pytest.mark.system" in file.read_text("utf-8")
    ]
    alone = (PYTEST + tuple(argv),) if argv else (LIVE, (*WAITING, *marked))
    parts: list[Check] = []
    try:
        for command in () if argv else PATIENT:
            parts.append(Check(command, beside=True))
            print(f"== in parallel, shown at the end: {parts[-1].name}", flush=True)
        beside = list(parts)
        for command in (*CHECKS, *alone):
            parts.append(Check(command))
            parts[-1].follow()
        for part in beside:
            part.follow()
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # the reader has ended, as with `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    finally:
        _stop([part.process for part in parts if part.process.poll() is None])
    return _summarise([*parts[len(beside) :], *beside], time.monotonic() - begun_s)


def _give_way() -> None:
    """Run only while a core is idle: Linux's idle class yields at once, niceness does not."""
    os.nice(19)
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def _stop(running: list[subprocess.Popen[bytes]]) -> None:
    """End the processes that still run, as Ctrl-C in their own terminal would."""
    for process in running:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGINT)
    until_s = time.monotonic() + ENDS_IN_S
    for process in running:
        with suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, until_s - time.monotonic()))
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def _summarise(done: list[Check], took_s: float) -> int:
    """Print the failures and the summary; return the exit code."""
    failures = [line for part in done for line in part.failures]
    for line in failures:
        print(f"== failed: {line}")
    skips: Counter[str] = Counter()
    for line in (line for part in done for line in part.lines):
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
