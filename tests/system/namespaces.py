"""Several hosts in one machine: network namespaces, a switch, and cables that can be pulled.

Every namespace is anonymous: it is there for as long as a process is in it. Each of those made
here is held open by a process whose input ends with this one, however that ends: a `cat` for
a host, this module as a program for the switch. This process itself has to be started in a
namespace of its own (`isolation`), which becomes the first of the hosts: the machine's own
network is never touched.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from pyroute2 import IPRoute
from pyroute2.netlink.exceptions import NetlinkError

_SUBNET: Final = "10.0.0"
_ENDING_S: Final = 10.0
"""A process that holds a namespace and is still there so long after its input's end hangs."""

_BRIDGE: Final = "switch"
_CARD: Final = "eth0"
"""Every host's network card."""
_NONLOCAL_BIND: Final = Path("/proc/sys/net/ipv4/ip_nonlocal_bind")

_ISOLATIONS: Final = (("unshare", "--net"), ("unshare", "--user", "--map-root-user", "--net"))
"""As root; and where everybody may be root of a user namespace of his own."""


@cache
def isolation() -> tuple[tuple[str, ...], str]:
    """Return the words before a command that give it a network namespace; or none, and why.

    What they start may make namespaces itself, and change settings of its own network.
    """
    if shutil.which("unshare") is None or shutil.which("nsenter") is None:
        return (), "unshare and nsenter are not installed (package util-linux)"
    needed = f"unshare --net true && echo 1 > {_NONLOCAL_BIND}"
    refusals = []
    for words in _ISOLATIONS:
        tried = subprocess.run(
            [*words, "sh", "-c", needed], capture_output=True, text=True, check=False
        )
        if tried.returncode == 0:
            return words, ""
        refusals.append(f"{' '.join(words)}: {tried.stderr.strip()}")
    return (), f"network namespaces are not permitted: {'; '.join(refusals)}"


def processes_in(namespaces: Sequence[str]) -> set[int]:
    """Return every process that is in one of these namespaces (`Network.namespaces`)."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has just ended, or is somebody else's
            if str((entry / "ns/net").readlink()) in namespaces:
                found.add(int(entry.name))
    return found


class Network:
    """Hosts on one switch; use it in a `with` statement.

    The first host is the namespace that this process is in.
    """

    def __init__(self, hosts: Sequence[str]) -> None:
        """Take the names of the hosts; at most 15 letters each, because they name interfaces."""
        self._hosts = tuple(hosts)
        self._pids = {hosts[0]: os.getpid()}
        self._switch: subprocess.Popen[str]
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        """Make namespaces, switch and cables, all of them up."""
        with contextlib.ExitStack() as stack:
            for host in self._hosts[1:]:
                self._pids[host] = stack.enter_context(_held("cat")).pid
            command = (sys.executable, "-m", "tests.system.namespaces")
            self._switch = stack.enter_context(_held(*command))
            self._order(*(["join", h, self._pids[h], self.address(h)] for h in self._hosts))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Let go of the namespaces; each ends with the last process in it."""
        self._stack.close()

    def address(self, host: str) -> str:
        """Return a host's IPv4 address."""
        return f"{_SUBNET}.{self._hosts.index(host) + 1}"

    def entering(self, host: str) -> list[str]:
        """Return the words before a command that run it on a host; none for this one."""
        pid = self._pids[host]
        return [] if pid == os.getpid() else ["nsenter", f"--net={_path(pid)}"]

    def namespaces(self) -> list[str]:
        """Return every namespace as the kernel names it: the hosts' and the switch's."""
        pids = (*self._pids.values(), self._switch.pid)
        return [str(Path(_path(pid)).readlink()) for pid in pids]

    def allow_foreign_addresses(self) -> None:
        """Let this host's processes bind to addresses of other hosts."""
        _NONLOCAL_BIND.write_text("1", encoding="ascii")

    def plug(self, host: str, *, plugged: bool) -> None:
        """Pull a host's cable out of the switch, or plug it in: the host's carrier goes, or comes.

        The kernel takes up to a second to pass a carrier on that has come back.
        """
        self._order(["set", host, "plugged", plugged])

    def forward(self, host: str, *, forwarded: bool) -> None:
        """Have the switch lose every frame from and to a host, or none: no carrier tells of it."""
        self._order(["set", host, "forwarded", forwarded])

    def _order(self, *orders: list[object]) -> None:
        """Have the switch carry out orders (`_obey`), and wait until it has."""
        assert self._switch.stdin is not None
        assert self._switch.stdout is not None
        self._switch.stdin.write(json.dumps(orders) + "\n")
        self._switch.stdin.flush()
        answer = self._switch.stdout.readline()
        assert answer == "null\n", f"the switch cannot do {orders}: {answer}"


@contextlib.contextmanager
def _held(*command: str) -> Iterator[subprocess.Popen[str]]:
    """Run a command in a network namespace of its own, until the end of its input."""
    with subprocess.Popen(
        ["unshare", "--net", *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write("[]\n")  # answered by what runs in the namespace
            process.stdin.flush()
            assert process.stdout.readline(), f"{command} has failed; its message is above"
            yield process
        finally:
            process.stdin.close()
            try:
                process.wait(_ENDING_S)
            except subprocess.TimeoutExpired:
                process.kill()
                raise


def _path(pid: int) -> str:
    return f"/proc/{pid}/ns/net"


class Switch:
    """A bridge in this process's own namespace.

    It speaks netlink by pyroute2, which forks to enter another namespace; so it is a small process
    without threads and signal handlers. A line on its input is a list of orders in JSON, and is
    answered by a line: `null`, or what was wrong. It ends at the end of its input.
    """

    def __init__(self, route: IPRoute) -> None:
        self._route = route
        route.link("add", ifname=_BRIDGE, kind="bridge")
        self._bridge = _index(route, _BRIDGE)
        route.link("set", index=self._bridge, state="up")

    def join(self, host: str, pid: int, address: str) -> None:
        """Lay a cable, a veth pair, to the namespace that a process is in."""
        route = self._route
        peer = {"ifname": _CARD, "net_ns_pid": pid}
        route.link("add", ifname=host, kind="veth", peer=peer)
        route.link("set", index=_index(route, host), master=self._bridge, state="up")
        with IPRoute(netns=f"/proc/{pid}/ns/net") as inside:
            for card in ("lo", _CARD):
                inside.link("set", index=_index(inside, card), state="up")
            inside.addr("add", index=_index(inside, _CARD), address=address, prefixlen=24)

    def set_port(self, host: str, what: str, *, on: bool) -> None:
        """Set whether a host's cable is plugged in, or whether its frames are forwarded."""
        port = _index(self._route, host)
        if what == "plugged":
            self._route.link("set", index=port, state="up" if on else "down")
        else:
            self._route.link("set", index=port, master=self._bridge if on else 0)


def _index(route: IPRoute, name: str) -> int:
    (index,) = route.link_lookup(ifname=name)
    return int(index)


def _obey(switch: Switch, order: Sequence[Any]) -> None:
    match order:
        case ["join", host, pid, address]:
            switch.join(host, pid, address)
        case ["set", host, what, on]:
            switch.set_port(host, what, on=on)


def main() -> None:
    """Be the switch until the end of the input."""
    with IPRoute() as route:
        switch = Switch(route)
        for line in sys.stdin:
            fault = None
            try:
                for order in json.loads(line):
                    _obey(switch, order)
            except NetlinkError as error:
                fault = str(error)
            sys.stdout.write(json.dumps(fault) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
