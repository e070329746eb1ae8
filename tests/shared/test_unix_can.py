"""The CAN bus over UNIX sockets: framing, batching, and never waiting for a slow client."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import can
import pytest

from services.simulator.fronts.unix_can_hub import TXQUEUELEN, UnixCanHub
from shared.can.unix_can import REMOTE_FLAG, UnixCanBus, pack_frames, unpack_frames
from shared.exceptions import FleetError


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


def test_packet_has_the_layout_of_socketcan_frames() -> None:
    frames = [(0x02E, b"\x01\x02\x03\x04"), (0x7FF | REMOTE_FLAG, b"")]
    packet = bytes.fromhex("2e000000 04000000 0102030400000000 ff070040 00000000 0000000000000000")
    assert pack_frames(frames) == packet
    assert unpack_frames(packet) == frames
    assert unpack_frames(bytes(17)) == [], "no row of whole frames"


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


def test_filters_of_python_can_apply(hub: UnixCanHub) -> None:
    wanted = [{"can_id": 0x10, "can_mask": 0x7FF, "extended": False}]
    with UnixCanBus(str(hub.path), can_filters=wanted) as bus:
        hub.poll()
        hub.broadcast([(0x11, b""), (0x10, b"\x07")])
        received = bus.recv(1.0)
        assert received is not None
        assert received.arbitration_id == 0x10
        assert bus.recv(0.01) is None


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
            bus.send_many([message(*frame) for frame in packet])
        assert bus.recv_many(1.0) == hub.poll() == frames
        assert bus.recv_many(0.0) == hub.poll() == []


def test_hub_hands_frames_to_the_other_clients_and_not_back(hub: UnixCanHub) -> None:
    with connect(hub) as sender, connect(hub) as listener:
        sender.send(message(5, b"x"))
        assert hub.poll() == [(5, b"x")]
        assert listener.recv_many(1.0) == [(5, b"x")]
        assert sender.recv_many(0.0) == []


def test_client_that_does_not_read_neither_blocks_the_hub_nor_the_others(hub: UnixCanHub) -> None:
    with connect(hub) as stopped, connect(hub) as reader:
        received = 0
        for _ in range(5000):
            hub.broadcast([(1, bytes(8))])
            received += len(reader.recv_many(0.0))
        assert received == 5000
        assert hub.dropped > 0
        assert len(stopped.recv_many(0.0)) == 5000 - hub.dropped


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


def test_frames_that_nobody_acknowledges_wait_in_order_and_outlive_their_sender(
    hub: UnixCanHub,
) -> None:
    hub.acknowledged = False
    with connect(hub) as bus:
        bus.send(message(1, b"first"))
        bus.send_many([message(2, b"second"), message(3, b"third")])
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


def test_the_send_queue_is_full_after_as_many_frames_as_the_interface_holds(
    hub: UnixCanHub,
) -> None:
    hub.acknowledged = False
    with connect(hub) as bus:
        fill(bus, TXQUEUELEN)
        assert bus.dropped == 0
        hub.poll()
        with pytest.raises(can.CanOperationError, match="No buffer space") as raised:
            bus.send(message(1, b""))
        assert raised.value.error_code == errno.ENOBUFS
        hub.acknowledged = True
        assert len(hub.poll()) == TXQUEUELEN
        bus.send(message(1, b""))


def test_a_queue_full_of_others_frames_refuses_ours_until_it_has_room(hub: UnixCanHub) -> None:
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
        bus.send_many([message(2, b"b"), message(3, b"c")])
        hub.poll()
        assert bus.recv_many(0.0) == []
        hub.acknowledged = True
        hub.poll()
        assert bus.recv_many(0.0) == [(1, b"a"), (2, b"b"), (3, b"c")]
        assert bus.recv_many(0.0) == []


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


def test_client_learns_that_the_hub_has_closed(path: Path) -> None:
    hub = UnixCanHub(path)
    with connect(hub) as bus:
        hub.close()
        with pytest.raises(can.CanOperationError):
            bus.recv_many(1.0)
        with pytest.raises(can.CanOperationError):
            bus.send(message(1, b""))


def test_receiving_gives_up_after_the_timeout_and_connecting_without_a_hub_at_once(
    path: Path,
) -> None:
    with pytest.raises(can.CanInitializationError, match=r"bus\.sock"):
        UnixCanBus(str(path))
    with UnixCanHub(path) as hub, connect(hub) as bus:
        begin = time.monotonic()
        assert bus.recv_many(0.02) == []
        assert time.monotonic() - begin >= 0.015


def test_connecting_does_not_wait_for_a_hub_that_does_not_accept(hub: UnixCanHub) -> None:
    clients: list[UnixCanBus] = []
    with pytest.raises(can.CanInitializationError):  # noqa: PT012
        while len(clients) < 100:
            clients.append(UnixCanBus(str(hub.path)))
    for client in clients:
        client.shutdown()
    assert clients


def test_stale_socket_file_is_replaced_and_removed_at_close(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(str(path))
    assert path.exists()
    with UnixCanHub(path) as hub, connect(hub) as bus:
        bus.send(message(1, b""))
        assert hub.poll() == [(1, b"")]
    assert not path.exists()


def test_path_that_cannot_be_the_hubs_is_refused_with_the_reason(path: Path) -> None:
    file, long = path.parent / "file", path.parent / ("x" * 120)
    file.write_text("precious")
    with UnixCanHub(path) as hub:
        for refused, why in ((path, "in use"), (file, "no socket"), (long, "107 bytes")):
            with pytest.raises(FleetError, match=why):
                UnixCanHub(refused)
        with connect(hub) as bus:  # the hub whose path was wanted goes on
            bus.send(message(1, b"z"))
            assert hub.poll() == [(1, b"z")]
    assert file.read_text() == "precious"


def test_closing_leaves_the_socket_of_a_successor(path: Path) -> None:
    old = UnixCanHub(path)
    path.unlink()
    with UnixCanHub(path):
        old.close()
        assert path.exists()
