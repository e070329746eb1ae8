"""Who may begin a link, and how many wait: this process's own listening sockets (Linux).

A TLS listener of Zenoh sleeps for 100 ms after each failed handshake, so a stranger who can reach
its port keeps new links off. It also takes in all that wait meanwhile, each with a descriptor: 640
connections a second that said nonsense left 4700 open in a minute. With a queue of one it takes in
no more than it ends. The kernel drops the packets of addresses that are not allowed before
there is a connection. A process may filter its own sockets without privilege (socket(7),
SO_ATTACH_FILTER); links inherit the filter.
"""

from __future__ import annotations

import contextlib
import ctypes
import ipaddress
import socket
import struct
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

from shared.exceptions import BusError

IpAddress: TypeAlias = "ipaddress.IPv4Address | ipaddress.IPv6Address"

ADDRESSES_MAX: Final = 64
"""Of each family; the kernel takes programs of 4096 instructions."""

_SO_ATTACH_FILTER: Final = 26
# Classic BPF, <linux/bpf_common.h> and <linux/filter.h>
_LOAD_WORD, _LOAD_BYTE, _AND, _JUMP, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x30, 0x54, 0x05, 0x15, 0x06
_SYN_COOKIES: Final = Path("/proc/sys/net/ipv4/tcp_syncookies")
_NETWORK_HEADER: Final = 0xFFF00000
"""SKF_NET_OFF: where an IP header begins, seen from any protocol."""
_SOURCE_4, _SOURCE_6 = 12, 8
_WHOLE: Final = 0xFFFFFFFF
_INSTRUCTION: Final = struct.Struct("HBBI")
_PROGRAM: Final = struct.Struct("HP")


class Instruction(NamedTuple):
    """One instruction of classic BPF."""

    code: int
    if_true: int
    if_false: int
    value: int


def program(allowed: Collection[IpAddress]) -> list[Instruction]:
    """Return a filter that keeps the packets of these source addresses and drops all others.

    Raises:
        BusError: there are more addresses than it takes.
    """
    four = [address for address in allowed if isinstance(address, ipaddress.IPv4Address)]
    six = [address for address in allowed if isinstance(address, ipaddress.IPv6Address)]
    if max(len(four), len(six)) > ADDRESSES_MAX:
        raise BusError(f"bus.security.allow: over {ADDRESSES_MAX} addresses")
    for_four = [Instruction(_LOAD_WORD, 0, 0, _NETWORK_HEADER + _SOURCE_4)]
    for address in four:
        for_four += [Instruction(_JUMP_IF_EQUAL, 0, 1, int(address)), _keep()]
    for_four.append(_drop())
    for_six: list[Instruction] = []
    for each in six:
        words = struct.unpack(">4I", each.packed)
        for index, word in enumerate(words):
            left = 2 * (len(words) - index - 1) + 1  # to the instruction after this address's
            load = Instruction(_LOAD_WORD, 0, 0, _NETWORK_HEADER + _SOURCE_6 + 4 * index)
            for_six += [load, Instruction(_JUMP_IF_EQUAL, 0, left, word)]
        for_six.append(_keep())
    for_six.append(_drop())
    return [
        Instruction(_LOAD_BYTE, 0, 0, _NETWORK_HEADER),
        Instruction(_AND, 0, 0, 0xF0),
        Instruction(_JUMP_IF_EQUAL, 1, 0, 0x40),  # over the jump: IPv4
        Instruction(_JUMP, 0, 0, len(for_four)),
        *for_four,
        *for_six,
    ]


def restrict(ports: Collection[int], allowed: Collection[IpAddress]) -> None:
    """Have this process's listening sockets at these ports hear allowed addresses, one at a time.

    Raises:
        BusError: one of the ports has no such socket, or the kernel takes no filter.
    """
    code = program(allowed)
    left = set(ports)
    for entry in Path("/proc/self/fd").iterdir():
        port = _listening_port(int(entry.name))
        if port in ports:
            _attach(int(entry.name), code)
            left.discard(port)
    if left:
        raise BusError(f"no filter of addresses for mtls: nothing listens at {sorted(left)}")


def resolved(hosts: Iterable[str]) -> tuple[set[IpAddress], list[str]]:
    """Return the addresses of hosts, and those that are not known.

    A name lookup may block: at the start only.
    """
    found: set[IpAddress] = set()
    unknown = []
    for host in hosts:
        try:
            rows = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError):
            unknown.append(host)
        else:
            found |= {ipaddress.ip_address(row[4][0]) for row in rows}
    return found, unknown


def _listening_port(descriptor: int) -> int | None:
    """Return the TCP port at which a descriptor of this process listens; None: at none."""
    with contextlib.suppress(OSError):  # another thread has closed it meanwhile; or no socket
        found = socket.socket(fileno=descriptor)
        try:
            of_ip = found.family in (socket.AF_INET, socket.AF_INET6)
            if of_ip and found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                return int(found.getsockname()[1])
        finally:
            found.detach()  # it is not ours to close
    return None


def _attach(descriptor: int, code: list[Instruction]) -> None:
    text = ctypes.create_string_buffer(b"".join(_INSTRUCTION.pack(*row) for row in code))
    packed = _PROGRAM.pack(len(code), ctypes.addressof(text))
    listener = socket.socket(fileno=descriptor)
    try:
        listener.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, packed)
        listener.listen(_waiting_max())
    except OSError as error:
        raise BusError(f"no filter of addresses for mtls: {error.strerror}") from None
    finally:
        listener.detach()


def _waiting_max() -> int:
    """Return the backlog for a queue of one; without SYN cookies the kernel then takes no call."""
    return 0 if _SYN_COOKIES.exists() and _SYN_COOKIES.read_text().strip() != "0" else 1


def _keep() -> Instruction:
    return Instruction(_RETURN, 0, 0, _WHOLE)


def _drop() -> Instruction:
    return Instruction(_RETURN, 0, 0, 0)
