"""CANSimple's layouts, the CAN bus over UNIX sockets, and an interface's queue."""

from __future__ import annotations

import errno
import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from enum import Enum, IntEnum
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.fronts.unix_can_hub import TXQUEUELEN, UnixCanHub
from shared.can import cansimple, cansimple_06
from shared.can.cansimple import AxisError, AxisState, Command, Heartbeat
from shared.can.cansimple_06 import (
    Command06,
    DriveError06,
    Heartbeat06,
    ProcedureResult,
    SdoOpcode,
    Version,
)
from shared.can.interface import QUEUED_MAX, limit_queue
from shared.can.unix_can import FRAME_BYTES, REMOTE_FLAG, UnixCanBus, pack_frames, unpack_frames

HEARTBEAT_06 = Heartbeat06(
    DriveError06.WATCHDOG_TIMER_EXPIRED, AxisState.IDLE, ProcedureResult.DISARMED, True
)
VERSION = Version(2, (4, 4, 58), (0, 6, 10), 0)

NUMBERS: dict[type[IntEnum], dict[str, int]] = {
    Command: {
        "HEARTBEAT": 0x001, "ESTOP": 0x002, "GET_MOTOR_ERROR": 0x003, "GET_ENCODER_ERROR": 0x004,
        "SET_AXIS_STATE": 0x007, "GET_ENCODER_ESTIMATES": 0x009, "GET_ENCODER_COUNT": 0x00A,
        "SET_CONTROLLER_MODE": 0x00B, "SET_INPUT_POS": 0x00C, "SET_INPUT_VEL": 0x00D,
        "SET_INPUT_TORQUE": 0x00E, "SET_LIMITS": 0x00F, "GET_IQ": 0x014, "REBOOT": 0x016,
        "GET_VBUS": 0x017, "CLEAR_ERRORS": 0x018, "SET_POS_GAIN": 0x01A, "SET_VEL_GAINS": 0x01B,
        "GET_CONTROLLER_ERROR": 0x01D,
    },
    Command06: {
        "GET_VERSION": 0x000, "GET_ERROR": 0x003, "RX_SDO": 0x004, "TX_SDO": 0x005,
        "ADDRESS": 0x006, "GET_TEMPERATURE": 0x015, "SET_ABSOLUTE_POSITION": 0x019,
        "GET_TORQUES": 0x01C, "GET_POWERS": 0x01D,
    },
    DriveError06: {  # type: ignore[dict-item]  # flags are integers as well
        "DRV_FAULT": 32, "DC_BUS_OVER_VOLTAGE": 256, "DC_BUS_OVER_REGEN_CURRENT": 2048,
        "INVERTER_OVER_TEMP": 16_384, "VELOCITY_LIMIT_VIOLATION": 32_768,
        "WATCHDOG_TIMER_EXPIRED": 16_777_216, "ESTOP_REQUESTED": 33_554_432,
        "SPINOUT_DETECTED": 67_108_864,
    },
}  # fmt: skip


@pytest.mark.parametrize("kind", NUMBERS)
def test_commands_and_errors_have_the_numbers_of_the_documents(kind: type[IntEnum]) -> None:
    assert {name: int(kind[name]) for name in NUMBERS[kind]} == NUMBERS[kind]


@pytest.mark.parametrize(
    ("ours", "name"),
    [(DriveError06, "ODriveError"), (ProcedureResult, "ProcedureResult"), (AxisState, "AxisState")],
)
def test_what_0_6_reports_is_named_as_in_the_odrive_package(ours: type[Enum], name: str) -> None:
    enums = pytest.importorskip("odrive.enums")
    theirs = {each.name: each.value for each in getattr(enums, name).__members__.values()}
    assert {each.name: each.value for each in ours.__members__.values()} == theirs


def test_ids_heartbeats_and_messages_of_0_6_are_read_back_as_written() -> None:
    assert cansimple.arbitration_id(3, Command.SET_INPUT_TORQUE) == 0x06E
    assert cansimple.arbitration_id(63, 0x1F) == 0x7FF
    assert cansimple.split_id(0x06E) == (3, Command.SET_INPUT_TORQUE)
    heartbeat = cansimple.unpack_heartbeat(bytes.fromhex("40000000 01 01 01 80"))
    assert heartbeat == Heartbeat(AxisError.MOTOR_FAILED, AxisState.IDLE, True, True, False, True)
    heartbeat = Heartbeat(0, AxisState.IDLE, True, False, True, False)
    assert heartbeat.errors == AxisError.MOTOR_FAILED | AxisError.CONTROLLER_FAILED
    assert Heartbeat(0, AxisState.IDLE, False, False, False, True).errors == 0
    assert cansimple_06.unpack_heartbeat(cansimple_06.pack_heartbeat(HEARTBEAT_06)) == HEARTBEAT_06
    assert cansimple_06.unpack_version(cansimple_06.pack_version(VERSION)) == VERSION
    assert cansimple_06.unpack_sdo(cansimple_06.pack_sdo(0, 77, b"abcd")) == (0, 77, b"abcd")


@pytest.mark.parametrize(
    ("packed", "by_hand"),
    [
        (cansimple.pack_u32(AxisState.CLOSED_LOOP_CONTROL), "08000000"),
        (cansimple.pack_two_floats(1.5, -2.0), "0000c03f 000000c0"),
        (cansimple.pack_float(-0.25), "000080be"),
        (cansimple.pack_i32(-2), "feffffff"),
        (cansimple.pack_two_ints(1, -2), "01000000 feffffff"),
        (cansimple.pack_input_pos(1.5, 1.0, -0.5), "0000c03f e803 0cfe"),
        (cansimple.pack_motor_error(0x2_0000_0001), "01000000 02000000"),
        (cansimple.pack_heartbeat(Heartbeat(0x800, 8, True, False, True, True)),
         "00080000 08 01 00 81"),
        (cansimple_06.pack_heartbeat(HEARTBEAT_06), "00000001 01 03 01 00"),
        (cansimple_06.pack_version(VERSION), "02 04 04 3a 00 06 0a 00"),
        (cansimple_06.pack_error(0x20, 0x0100_0000), "20000000 00000001"),
        (cansimple_06.pack_sdo(SdoOpcode.WRITE, 0x0123, b"\x01\x02"), "01 2301 00 0102"),
    ],
)  # fmt: skip
def test_payload_equals_the_bytes_written_by_hand(packed: bytes, by_hand: str) -> None:
    assert packed == bytes.fromhex(by_hand)


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_feedforward_of_input_pos_saturates_and_never_wraps(vel: float, torque: float) -> None:
    _, vel_back, torque_back = cansimple.unpack_input_pos(cansimple.pack_input_pos(0, vel, torque))
    for asked, got in ((vel, vel_back), (torque, torque_back)):
        assert math.isclose(got, max(-32.767, min(32.767, asked)), abs_tol=0.0006)


@pytest.fixture
def path(short_dir: Path) -> Path:
    return short_dir / "bus.sock"


@pytest.fixture
def hub(path: Path) -> Iterator[UnixCanHub]:
    with UnixCanHub(path) as hub:
        yield hub


def connect(hub: UnixCanHub) -> UnixCanBus:
    bus = UnixCanBus(str(hub.path))
    before = hub.clients
    hub.poll()
    assert hub.clients == before + 1
    return bus


def message(can_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def test_frames_go_to_the_other_clients_only_in_socketcans_layout(hub: UnixCanHub) -> None:
    frames = [(0x02E, b"\x01\x02\x03\x04"), (0x7FF | REMOTE_FLAG, b"")]
    packet = bytes.fromhex("2e000000 04000000 0102030400000000 ff070040 00000000 0000000000000000")
    assert pack_frames(frames) == packet
    assert unpack_frames(packet) == frames
    assert unpack_frames(bytes(17)) == [], "no row of whole frames"
    with connect(hub) as sender, connect(hub) as listener:
        sender.send(message(5, b"x"))
        assert hub.poll() == [(5, b"x")]
        assert unpack_frames(listener.recv_packet(1.0)) == [(5, b"x")]
        assert sender.recv_packet(0.0) == b""


def test_python_can_finds_the_interface_by_its_name(hub: UnixCanHub) -> None:
    with can.Bus(interface="xrl_unix", channel=str(hub.path), ignore_config=True) as bus:
        assert isinstance(bus, UnixCanBus)
        bus.send(message(0x123, b"\xaa\xbb"))
        assert hub.poll() == [(0x123, b"\xaa\xbb")]
        hub.broadcast([(0x321, b"\x01"), (0x322, b"\x02\x03")])
        first, second = bus.recv(1.0), bus.recv(1.0)
        assert (first.arbitration_id, bytes(first.data)) == (0x321, b"\x01")
        assert (second.arbitration_id, bytes(second.data)) == (0x322, b"\x02\x03")
        assert not first.is_extended_id
        assert bus.recv(0.0) is None


PACKETS = {
    "one frame": [[(3, b"")]],
    "two in one packet": [[(1, b"a"), (2, b"b")]],
    "two packets": [[(1, b"a"), (2, b"b")], [(3, b"c")]],
}


@pytest.mark.parametrize("packets", PACKETS.values(), ids=PACKETS)
def test_all_frames_of_all_packets_arrive_in_order_either_way(
    hub: UnixCanHub, packets: list[list[tuple[int, bytes]]]
) -> None:
    frames = [frame for packet in packets for frame in packet]
    with connect(hub) as bus:
        for packet in packets:
            hub.broadcast(packet)
            bus.send_packet(pack_frames(packet))
        assert unpack_frames(bus.recv_packet(1.0)) == hub.poll() == frames
        assert unpack_frames(bus.recv_packet(0.0)) == hub.poll() == []


def test_client_that_does_not_read_neither_blocks_the_hub_nor_the_others(hub: UnixCanHub) -> None:
    with connect(hub) as stopped, connect(hub) as reader:
        received = 0
        for _ in range(5000):
            hub.broadcast([(1, bytes(8))])
            received += len(reader.recv_packet(0.0)) // FRAME_BYTES
        assert received == 5000
        assert hub.dropped > 0
        assert len(stopped.recv_packet(0.0)) == FRAME_BYTES * (5000 - hub.dropped)


def fill(bus: UnixCanBus, frames: int) -> None:
    """Send frames, whether there is room or not."""
    for _ in range(frames):
        with suppress(can.CanOperationError):
            bus.send(message(1, bytes(8)))


def test_send_to_a_hub_that_does_not_read_raises_and_counts(hub: UnixCanHub) -> None:
    with connect(hub) as bus:
        fill(bus, 5000)
        assert bus.dropped > 0
        assert sum(map(len, iter(hub.poll, []))) == 5000 - bus.dropped
        bus.send(message(1, b"there is room again"[:8]))


# ---- a bus on which nobody acknowledges


def test_what_nobody_acknowledges_waits_in_order_and_a_restart_throws_it_away(
    hub: UnixCanHub,
) -> None:
    hub.acknowledged = False
    with connect(hub) as bus:
        bus.send(message(1, b"first"))
        bus.send_packet(pack_frames([(2, b"second"), (3, b"third")]))
    assert hub.poll() == []
    with connect(hub) as late:
        late.send(message(4, b"late"))
        hub.acknowledged = True
        frames = hub.poll()
        frames.remove((4, b"late"))
        assert frames == [(1, b"first"), (2, b"second"), (3, b"third")]


def test_a_restart_of_the_interface_throws_away_what_all_clients_have_waiting(
    hub: UnixCanHub,
) -> None:
    hub.acknowledged = False
    with connect(hub) as bus:
        dead = connect(hub)
        dead.send(message(1, b"of the dead"))
        dead.shutdown()
        bus.send(message(2, b"old"))
        bus.restart()
        assert hub.poll() == []
        hub.acknowledged = True
        bus.send(message(3, b"new"))
        assert hub.poll() == [(3, b"new")]
        assert hub.clients == 1


def test_a_send_queue_holds_as_many_frames_as_the_interface_and_refuses_more(
    hub: UnixCanHub,
) -> None:
    hub.acknowledged = False
    with connect(hub) as bus:
        fill(bus, TXQUEUELEN)
        assert bus.dropped == 0
        hub.poll()
        with pytest.raises(can.CanOperationError, match="queue full") as raised:
            bus.send(message(1, b""))
        assert raised.value.error_code == errno.ENOBUFS
        hub.acknowledged = True
        assert len(hub.poll()) == TXQUEUELEN
        bus.send(message(1, b""))
        assert len(hub.poll()) == 1
    hub.poll()
    with connect(hub) as bus:
        hub.choked = True
        hub.poll()
        fill(bus, 3)
        assert hub.poll() == []
        assert bus.dropped == 3
        hub.choked = False
        hub.poll()
        bus.send(message(9, b""))
        assert hub.poll() == [(9, b"")]


def test_own_frames_come_back_once_the_bus_has_carried_them(hub: UnixCanHub) -> None:
    with UnixCanBus(str(hub.path), receive_own_messages=True) as bus:
        hub.poll()
        hub.acknowledged = False
        bus.send(message(1, b"a"))
        bus.send_packet(pack_frames([(2, b"b"), (3, b"c")]))
        hub.poll()
        assert bus.carried() == b""
        hub.acknowledged = True
        hub.poll()
        assert unpack_frames(bus.carried()) == [(1, b"a"), (2, b"b"), (3, b"c")]
        assert bus.carried() == b""


@pytest.mark.parametrize("broadcast_to", ["the leaving", "the left", "nobody"])
def test_what_a_client_sent_before_it_left_arrives(hub: UnixCanHub, broadcast_to: str) -> None:
    """A tool that sends one order and goes; the kernel tells of frames it left unread first."""
    with connect(hub) as talker:
        leaving = connect(hub)
        if broadcast_to == "the leaving":
            hub.broadcast([(0x1, b"unread")])
        leaving.send(message(0x55, b"order"))
        leaving.shutdown()
        if broadcast_to == "the left":
            hub.broadcast([(0x1, b"too late")])
        talker.send(message(0x2, b"too"))
        assert sorted(hub.poll()) == [(0x2, b"too"), (0x55, b"order")]
        assert hub.poll() == []
        assert hub.clients == 1


def test_receiving_gives_up_after_the_timeout_and_connecting_without_a_hub_at_once(
    path: Path,
) -> None:
    with pytest.raises(can.CanInitializationError, match=r"bus\.sock"):
        UnixCanBus(str(path))
    with UnixCanHub(path) as hub, connect(hub) as bus:
        begin = time.monotonic()
        assert bus.recv_packet(0.02) == b""
        assert time.monotonic() - begin >= 0.015


def test_a_hub_replaces_a_stale_socket_and_its_clients_learn_that_it_closed(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(str(path))
    assert path.exists()
    with UnixCanHub(path) as hub, connect(hub) as bus:
        bus.send(message(1, b""))
        assert hub.poll() == [(1, b"")]
    assert not path.exists()
    hub = UnixCanHub(path)
    with connect(hub) as bus:
        hub.close()
        with pytest.raises(can.CanOperationError):
            bus.recv_packet(1.0)
        with pytest.raises(can.CanOperationError):
            bus.send(message(1, b""))


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
