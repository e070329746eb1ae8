"""What a terminal sends, as keys."""

from __future__ import annotations

import os
import pty
import signal
import sys
import termios
import time
from enum import Enum
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tools.keyboard import Keyboard, is_hung_up, typed_line, understood
from tools.verbs import lead


class Press(Enum):
    """Keys that mean something here."""

    PAUSE = " "
    STEP = "right"
    QUIT = "q"


PRESSES = {
    b" ": Press.PAUSE, b"q": Press.QUIT, b"\x1b[C": Press.STEP, b"\x1bOC": Press.STEP,
}  # fmt: skip


@given(st.lists(st.sampled_from(sorted(PRESSES))), st.integers(1, 3))
def test_keys_are_understood_however_their_bytes_come(typed: list[bytes], size: int) -> None:
    text = b"".join(typed)
    found, rest = [], b""
    for start in range(0, len(text), size):
        presses, rest = understood(rest + text[start : start + size], PRESSES)
        found += presses
    assert found == [PRESSES[code] for code in typed]
    assert rest == b""


@given(st.binary())
def test_whatever_comes_leaves_no_more_than_the_start_of_a_key(text: bytes) -> None:
    _, rest = understood(text, PRESSES)
    assert rest in {code[:n] for code in PRESSES for n in range(3)} | {b"\x1b[", b"\x1bO"}


def test_other_keys_mean_nothing() -> None:
    assert understood(b"xyz\r\n\x1b[5~", PRESSES) == ([], b"")


def test_on_a_pipe_it_only_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.write(write, b" q")
    with os.fdopen(read) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        with Keyboard(PRESSES) as keyboard:
            assert not keyboard.present
            assert keyboard.wait(0.001) == []
    os.close(write)


@pytest.mark.parametrize("typed", ["after fg", "before it"])
def test_the_stop_key_counts_after_ctrl_z_and_fg(typed: str) -> None:
    """The shell leaves the terminal with line editing: no key came through until Enter."""
    pid, descriptor = pty.fork()
    if pid == 0:  # a terminal of its own: never back into pytest
        code = 1
        try:
            sys.stdin = os.fdopen(0)
            pressed: list[lead.Key] = []
            with Keyboard(lead.KEYS) as keyboard:
                os.write(1, b"ready")
                ends_s = time.monotonic() + 5.0
                while not pressed and time.monotonic() < ends_s:
                    pressed = keyboard.wait(lead.PERIOD_S)
            code = 0 if pressed == [lead.Key.STOP] else 2
        finally:
            os._exit(code)
    told = b""
    while b"ready" not in told:
        told += os.read(descriptor, 100)
    os.kill(pid, signal.SIGSTOP)
    os.waitpid(pid, os.WUNTRACED)
    by_line = termios.tcgetattr(descriptor)
    by_line[3] |= termios.ICANON
    termios.tcsetattr(descriptor, termios.TCSADRAIN, by_line)
    if typed == "before it":
        os.write(descriptor, b"x")
    os.kill(pid, signal.SIGCONT)
    if typed == "after fg":
        time.sleep(2 * lead.PERIOD_S)
        os.write(descriptor, b"x")
    _, status = os.waitpid(pid, 0)
    os.close(descriptor)
    assert os.waitstatus_to_exitcode(status) == 0


def test_a_terminal_whose_other_end_is_closed_is_hung_up() -> None:
    person, terminal = pty.openpty()
    assert not is_hung_up(terminal)
    os.close(person)
    assert is_hung_up(terminal)
    os.close(terminal)
    with Path(os.devnull).open() as no_terminal:
        assert not is_hung_up(no_terminal)


def test_a_terminal_that_is_gone_enters_an_empty_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """The line that lays no pendant down: `xrl pendant` and `xrl estop --wait` then stop."""
    person, terminal = pty.openpty()
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        assert typed_line(0.001) is None
        os.close(person)
        assert [typed_line(0.001) for _ in range(3)] == ["", "", ""]


def test_a_terminal_is_given_back_as_it_was() -> None:
    pid, descriptor = pty.fork()
    if pid == 0:  # a terminal of its own: never back into pytest
        code = 1
        try:
            sys.stdin = os.fdopen(0)
            before = termios.tcgetattr(0)
            with Keyboard(PRESSES) as keyboard:
                os.write(1, b"ready")
                pressed = keyboard.wait(20.0)
                changed = termios.tcgetattr(0) != before
            back = termios.tcgetattr(0) == before
            code = 0 if pressed == [Press.PAUSE] and changed and back else 2
        finally:
            os._exit(code)
    typed = b""
    while b"ready" not in typed:
        typed += os.read(descriptor, 100)
    os.write(descriptor, b" ")
    _, status = os.waitpid(pid, 0)
    os.close(descriptor)
    assert os.waitstatus_to_exitcode(status) == 0
