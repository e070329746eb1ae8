"""A CAN interface's queue: how long it may get, and a restart that empties it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress

import pytest

from shared.can.interface import QUEUED_MAX, limit_queue, restart

RESTART = """
import subprocess
from shared.can.interface import restart
subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
subprocess.run(["ip", "route", "add", "10.9.9.0/24", "dev", "lo"], check=True)
restart(None, "lo")
print(subprocess.run(["ip", "route"], capture_output=True, text=True, check=True).stdout.strip())
print(subprocess.run(["ip", "-o", "link", "show", "lo", "up"], capture_output=True).stdout != b"")
"""


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with near, far:
        yield near, far


def test_a_row_of_frames_waits_and_not_many_more(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    class Bus:
        socket = pair[0]

    limit_queue(Bus())
    taken = 0
    with suppress(BlockingIOError):
        while taken < 1000:
            pair[0].send(bytes(16), socket.MSG_DONTWAIT)
            taken += 1
    assert QUEUED_MAX <= taken <= 2 * QUEUED_MAX + 1
    limit_queue(object())  # of an interface without a socket nothing is known


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has network namespaces")
def test_a_restart_takes_an_interface_down_and_up() -> None:
    """Of the loopback in a namespace of its own: going down loses its route."""
    words = ["unshare", "-n", sys.executable, "-c", RESTART]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert done.stdout.splitlines() == ["", "True"], done.stderr


def test_an_interface_that_is_not_there_is_an_error() -> None:
    with pytest.raises(OSError, match="No such device"):
        restart(None, "can_nowhere")
