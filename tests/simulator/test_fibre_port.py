"""The emulated drives' USB plugs."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.fronts.fibre_front import EmulatedBoard, FibreFront
from services.simulator.fronts.fibre_port import CHECK_EVERY, FibreHub, FibrePort
from tests.simulator.banks import idle_bank

VERSION = struct.pack("<HHHIH", 0x81, 0x8000, 4, 0xFFFF_FFFF, 1)
"""Asks for the id of the descriptor."""


@pytest.fixture
def bank() -> AxisBank:
    return idle_bank()


@pytest.fixture
def hub(bank: AxisBank, tmp_path: Path) -> Iterator[FibreHub]:
    hub = FibreHub(
        [FibrePort(FibreFront(EmulatedBoard(bank, i, 16 + i)), tmp_path / str(i)) for i in range(6)]
    )
    yield hub
    hub.close()


@pytest.fixture
def client() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
        client.settimeout(5.0)
        yield client


def look(hub: FibreHub) -> None:
    for _ in range(CHECK_EVERY):
        hub.poll()


def test_a_client_is_admitted_and_all_that_it_has_sent_is_answered_in_order(
    hub: FibreHub, client: socket.socket, tmp_path: Path
) -> None:
    client.connect(str(tmp_path / "3"))
    look(hub)
    assert hub.clients == 1
    for number in range(8):
        client.send(struct.pack("<H", 0x80 + number) + VERSION[2:])
    hub.poll()
    answers = [struct.unpack_from("<H", client.recv(64))[0] & 0x7FFF for _ in range(8)]
    assert answers == list(range(0x80, 0x88))


def test_a_client_that_leaves_is_forgotten(
    hub: FibreHub, client: socket.socket, tmp_path: Path
) -> None:
    client.connect(str(tmp_path / "0"))
    look(hub)
    client.close()
    look(hub)
    assert hub.clients == 0
    assert not hub.ports[0].clients


def test_a_board_that_goes_silent_answers_nothing_more_and_is_gone(
    hub: FibreHub, bank: AxisBank, client: socket.socket, tmp_path: Path
) -> None:
    client.connect(str(tmp_path / "2"))
    look(hub)
    bank.conditions.link(2, up=False)
    client.send(VERSION)
    hub.poll()
    with suppress(ConnectionResetError):  # its question was not even read
        assert client.recv(64) == b""
    assert not (tmp_path / "2").exists()
    assert hub.clients == 0


def test_a_plug_that_is_in_again_takes_clients_again(
    hub: FibreHub, bank: AxisBank, client: socket.socket, tmp_path: Path
) -> None:
    bank.conditions.link(2, up=False)
    look(hub)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1", "3", "4", "5"]
    bank.conditions.link(2, up=True)
    look(hub)
    client.connect(str(tmp_path / "2"))
    look(hub)
    client.send(VERSION)
    hub.poll()
    assert client.recv(64)


def test_nothing_is_left_after_closing(hub: FibreHub, tmp_path: Path) -> None:
    hub.close()
    assert list(tmp_path.iterdir()) == []
