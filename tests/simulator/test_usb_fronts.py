"""The Fibre protocol of an emulated board, its USB plug, and the stand-in for libusb."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_settings import NAMES
from services.simulator.fronts import usb_standin
from services.simulator.fronts.fibre_front import CODECS, EmulatedBoard, FibreFront, crc16
from services.simulator.fronts.fibre_port import CHECK_EVERY, FibreHub, FibrePort
from shared.can.cansimple import AxisError, AxisState
from shared.run_directory import live_dir
from tests.simulator.banks import DRIVE, ZERO, idle_bank

MODULE = 1
SERIAL = 0x365A335A3438
ANSWER = 0x8000


class Client:
    """Speaks to a front as docs/protocol.rst of the ODrive repository has it."""

    def __init__(self, front: FibreFront) -> None:
        self.front = front
        self.trailer = 1
        text = b""
        while part := self.operate(0, 32, struct.pack("<I", len(text))):
            text += part
        self.text = text
        self.trailer = crc16(1, text)
        self.endpoints = dict(flat("", json.loads(text)))

    def operate(self, number: int, size: int, payload: bytes = b"") -> bytes:
        """Return the payload of an operation's answer."""
        trailer = self.trailer if number else 1
        packet = struct.pack("<HHH", 0x81, number | ANSWER, size) + payload
        answer = self.front.answer(packet + struct.pack("<H", trailer))
        assert answer is not None
        assert struct.unpack_from("<H", answer) == (0x81 | ANSWER,)
        return answer[2:]

    def exchange(self, name: str, *value: float) -> Any:
        """Read an endpoint, with a value: write it too; return what it held."""
        row = self.endpoints[name]
        codec = CODECS[row["type"]]
        payload = codec.pack(*value) if value else b""
        return codec.unpack(self.operate(row["id"], codec.size, payload))[0]

    def call(self, name: str) -> None:
        """Call a function."""
        row = self.endpoints[name]
        assert row["type"] == "function"
        assert self.operate(row["id"], 0) == b""


def flat(prefix: str, members: list[dict[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    rows: list[tuple[str, dict[str, Any]]] = []
    for member in members:
        name = prefix + member["name"]
        if member["type"] == "object":
            rows += flat(name + ".", member["members"])
        else:
            rows.append((name, member))
            rows += flat(name + ".", member.get("inputs", []))
    return rows


@pytest.fixture
def bank() -> AxisBank:
    return idle_bank()


@pytest.fixture
def front(bank: AxisBank) -> FibreFront:
    return FibreFront(EmulatedBoard(bank, MODULE, SERIAL))


@pytest.fixture
def client(front: FibreFront) -> Client:
    return Client(front)


@pytest.mark.parametrize(
    ("data", "crc"), [(b"\x01\x02\x03\x04", 0x672E), (b"\x05\x04\x03\x02\x01", 0xE251)]
)
def test_the_crc_is_that_of_the_protocols_examples(data: bytes, crc: int) -> None:
    assert crc16(0x1337, data) == crc


def test_the_descriptor_comes_in_parts_with_its_checksum_and_is_the_same_for_all_boards(
    client: Client, bank: AxisBank
) -> None:
    assert client.text == client.front.descriptor
    assert client.endpoints[""] == {"name": "", "id": 0, "type": "json", "access": "r"}
    (version,) = struct.unpack("<I", client.operate(0, 4, b"\xff\xff\xff\xff"))
    assert version >> 16 == crc16(1, client.text)
    assert version & 0xFFFF == crc16(crc16(1, client.text), client.text)
    first, second = (FibreFront(EmulatedBoard(bank, module, SERIAL + module)) for module in (0, 5))
    assert first.descriptor == second.descriptor


def test_every_endpoint_has_its_own_id_and_reads_as_the_bank_has_it(
    client: Client, bank: AxisBank
) -> None:
    rows = [row for name, row in client.endpoints.items() if name]
    assert sorted(row["id"] for row in rows) == list(range(1, len(rows) + 1))
    for name, row in client.endpoints.items():
        if row["type"] in CODECS:
            client.exchange(name)
    for name in NAMES:
        assert client.endpoints[name]["access"] == "rw"
        assert client.exchange(name) == pytest.approx(bank.settings.get(MODULE, name), rel=1e-6)


def test_an_exchange_returns_the_value_before_in_at_most_the_bytes_asked_for(
    client: Client, bank: AxisBank
) -> None:
    assert client.exchange("axis1.controller.input_torque", 0.5) == 0.0
    assert client.exchange("axis1.controller.input_torque") == 0.5
    assert bank.input_torque[2 * MODULE : 2 * MODULE + 2].tolist() == [0.0, 0.5]
    number = client.endpoints["vbus_voltage"]["id"]
    assert [len(client.operate(number, size)) for size in (0, 2, 4, 8)] == [0, 2, 4, 4]
    assert client.operate(0, 512, struct.pack("<I", 3)) == client.front.descriptor[3:64]
    for number in (1 + max(row["id"] for row in client.endpoints.values()), 0x7FFF):
        assert client.operate(number, 4) == b""


@pytest.mark.parametrize(
    ("flags", "wrong", "written"),
    [(0, 0, 1.5), (ANSWER, 1, 0.0)],
    ids=["wants no answer: carried out", "of another descriptor: ignored"],
)
def test_a_request_without_an_answer(
    client: Client, bank: AxisBank, flags: int, wrong: int, written: float
) -> None:
    number = client.endpoints["axis0.controller.input_vel"]["id"]
    packet = struct.pack("<HHHfH", 0x81, number | flags, 0, 1.5, client.trailer ^ wrong)
    assert client.front.answer(packet) is None
    assert client.front.ignored == wrong
    assert bank.input_vel[2 * MODULE] == written


def test_no_packet_makes_the_front_fail(client: Client) -> None:
    @given(packet=st.binary(max_size=80))
    def answered(packet: bytes) -> None:
        client.front.answer(packet)
        client.front.answer(packet + struct.pack("<H", client.trailer))

    answered()


def test_native_writes_feed_no_watchdog_but_its_function_does(
    client: Client, bank: AxisBank
) -> None:
    axis = 2 * MODULE
    bank.step(0.9 * DRIVE.watchdog_timeout, ZERO, ZERO)
    client.call("axis0.watchdog_feed")
    client.exchange("axis1.controller.input_torque", 0.0)
    bank.step(1.1 * DRIVE.watchdog_timeout, ZERO, ZERO)
    assert bank.faults[axis].axis == 0
    assert bank.faults[axis + 1].axis == AxisError.WATCHDOG_TIMER_EXPIRED


def test_a_state_and_a_mode_go_to_the_axis_and_one_that_does_not_exist_is_an_error(
    client: Client, bank: AxisBank
) -> None:
    assert client.exchange("axis1.requested_state", AxisState.CLOSED_LOOP_CONTROL) == 0
    assert client.exchange("axis1.current_state") == AxisState.CLOSED_LOOP_CONTROL
    assert client.exchange("axis0.current_state") == AxisState.IDLE
    assert client.exchange("axis1.motor.is_armed") is True
    client.exchange("axis1.requested_state", AxisState.IDLE)
    bank.input_pos[:] = 3.0
    client.exchange("axis0.controller.config.input_mode", 1)
    assert client.exchange("axis0.controller.input_pos") == 3.0
    client.exchange("axis0.controller.config.control_mode", 3)
    assert client.exchange("axis0.controller.input_pos") == 0.0, "the motor's place is its target"
    client.exchange("axis0.controller.config.control_mode", 1)
    assert client.exchange("axis0.controller.config.control_mode") == 1
    client.exchange("axis0.controller.config.input_mode", 5)
    assert client.exchange("axis0.controller.error") == 2
    assert client.exchange("axis0.controller.config.input_mode") == 1


VERSION = struct.pack("<HHHIH", 0x81, 0x8000, 4, 0xFFFF_FFFF, 1)
"""Asks for the id of the descriptor."""


@pytest.fixture
def hub(bank: AxisBank, tmp_path: Path) -> Iterator[FibreHub]:
    hub = FibreHub(
        [FibrePort(FibreFront(EmulatedBoard(bank, i, 16 + i)), tmp_path / str(i)) for i in range(6)]
    )
    yield hub
    hub.close()


@pytest.fixture
def plugged() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as plugged:
        plugged.settimeout(5.0)
        yield plugged


def look(hub: FibreHub) -> None:
    for _ in range(CHECK_EVERY):
        hub.poll()


def test_a_client_is_admitted_answered_in_order_and_forgotten_when_it_leaves(
    hub: FibreHub, plugged: socket.socket, tmp_path: Path
) -> None:
    plugged.connect(str(tmp_path / "3"))
    look(hub)
    assert hub.clients == 1
    for number in range(8):
        plugged.send(struct.pack("<H", 0x80 + number) + VERSION[2:])
    hub.poll()
    answers = [struct.unpack_from("<H", plugged.recv(64))[0] & 0x7FFF for _ in range(8)]
    assert answers == list(range(0x80, 0x88))
    plugged.close()
    look(hub)
    assert hub.clients == 0
    assert not hub.ports[3].clients
    hub.close()
    assert list(tmp_path.iterdir()) == []


def test_a_silent_board_answers_nothing_and_is_unplugged_until_it_is_back(
    hub: FibreHub, bank: AxisBank, plugged: socket.socket, tmp_path: Path
) -> None:
    plugged.connect(str(tmp_path / "2"))
    look(hub)
    bank.conditions.link(2, up=False)
    plugged.send(VERSION)
    hub.poll()
    with suppress(ConnectionResetError):  # its question was not even read
        assert plugged.recv(64) == b""
    assert not (tmp_path / "2").exists()
    assert hub.clients == 0


def test_the_stand_in_compiles_without_a_warning_and_is_rebuilt_for_a_newer_source(
    tmp_path: Path,
) -> None:
    library = usb_standin.build(tmp_path)
    assert library == tmp_path / usb_standin.SONAME
    inode = library.stat().st_ino
    assert usb_standin.build(tmp_path).stat().st_ino == inode
    os.utime(library, (0, 0))
    assert usb_standin.build(tmp_path).stat().st_ino != inode
    assert list(tmp_path.iterdir()) == [library]
    command = ["cc", "-std=gnu11", "-Wall", "-Wextra", "-Wno-unused-parameter", "-Werror", "-c"]
    subprocess.run([*command, "-o", tmp_path / "o", usb_standin.SOURCE], check=True)


def test_it_prepares_paths_of_its_own_and_clears_them_but_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LD_LIBRARY_PATH", "/opt/lib")
    environment = usb_standin.prepare(tmp_path)
    first, _, rest = environment["LD_LIBRARY_PATH"].partition(":")
    assert (Path(first) / usb_standin.SONAME).is_file()
    assert rest == "/opt/lib"
    assert environment[usb_standin.VARIABLE] == str(live_dir(tmp_path) / usb_standin.FOLDER)
    assert Path(environment["XDG_CACHE_HOME"]).is_relative_to(tmp_path)
    usb_standin.clear(tmp_path)
    usb_standin.prepare(tmp_path)
    plugs = live_dir(tmp_path) / usb_standin.FOLDER
    plugs.mkdir(parents=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as plug:
        plug.bind(str(plugs / "3A0000000001"))
    (plugs / "notes.txt").write_text("mine")
    usb_standin.clear(tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert [path.name for path in plugs.iterdir()] == ["notes.txt"]
    (plugs / "notes.txt").unlink()
    usb_standin.clear(tmp_path)
    assert not plugs.exists()
