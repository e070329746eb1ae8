"""Several hosts in one machine: network namespaces, a switch, and cables that can be pulled.

Every namespace is anonymous: it is there for as long as a process is in it. Each of those made
here is held open by a `cat` whose input ends with this process, however that ends; the switch has
one of its own. This process itself has to be started in a namespace of its own (`isolation`), which
becomes the first of the hosts: the machine's own network is never touched.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Final, Self

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
    for program, package in (
        ("unshare", "util-linux"),
        ("nsenter", "util-linux"),
        ("ip", "iproute2"),
    ):
        if shutil.which(program) is None:
            return (), f"{program} is not installed (package {package})"
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


class Network(contextlib.ExitStack):
    """Hosts on one switch; use it in a `with` statement.

    The first host is the namespace that this process is in. Each namespace ends with the last
    process in it.
    """

    def __init__(self, hosts: Sequence[str]) -> None:
        """Take the names of the hosts; at most 15 letters each, because they name interfaces."""
        super().__init__()
        self._hosts = tuple(hosts)
        self._pids = {hosts[0]: os.getpid()}
        self._switch = 0

    def __enter__(self) -> Self:
        """Make namespaces, switch and cables, all of them up."""
        with contextlib.ExitStack() as stack:
            for host in self._hosts[1:]:
                self._pids[host] = stack.enter_context(_held())
            self._switch = stack.enter_context(_held())
            _ip(self._switch, "link", "add", _BRIDGE, "up", "type", "bridge")
            for host, pid in self._pids.items():
                peer = ("peer", "name", _CARD, "netns", str(pid))
                _ip(self._switch, "link", "add", host, "type", "veth", *peer)
                _ip(self._switch, "link", "set", host, "master", _BRIDGE, "up")
                for card in ("lo", _CARD):
                    _ip(pid, "link", "set", card, "up")
                _ip(pid, "address", "add", f"{self.address(host)}/24", "dev", _CARD)
            self.push(stack.pop_all())
        return super().__enter__()

    def address(self, host: str) -> str:
        """Return a host's IPv4 address."""
        return f"{_SUBNET}.{self._hosts.index(host) + 1}"

    def entering(self, host: str) -> list[str]:
        """Return the words before a command that run it on a host; none for this one."""
        pid = self._pids[host]
        return [] if pid == os.getpid() else ["nsenter", f"--net={_path(pid)}"]

    def namespaces(self) -> list[str]:
        """Return every namespace as the kernel names it: the hosts' and the switch's."""
        pids = (*self._pids.values(), self._switch)
        return [str(Path(_path(pid)).readlink()) for pid in pids]

    def allow_foreign_addresses(self) -> None:
        """Let this host's processes bind to addresses of other hosts."""
        _NONLOCAL_BIND.write_text("1", encoding="ascii")

    def plug(self, host: str, *, plugged: bool) -> None:
        """Pull a host's cable out of the switch, or plug it in: the host's carrier goes, or comes.

        The kernel takes up to a second to pass a carrier on that has come back.
        """
        _ip(self._switch, "link", "set", host, "up" if plugged else "down")

    def forward(self, host: str, *, forwarded: bool) -> None:
        """Have the switch lose every frame from and to a host, or none: no carrier tells of it."""
        port = ("master", _BRIDGE) if forwarded else ("nomaster",)
        _ip(self._switch, "link", "set", host, *port)


@contextlib.contextmanager
def _held() -> Iterator[int]:
    """Hold a network namespace open; yields the process that is in it."""
    with subprocess.Popen(
        ["unshare", "--net", "cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write("up\n")  # answered by what runs in the namespace
            process.stdin.flush()
            assert process.stdout.readline(), "unshare has failed; its message is above"
            yield process.pid
        finally:
            process.stdin.close()
            try:
                process.wait(_ENDING_S)
            except subprocess.TimeoutExpired:
                process.kill()
                raise


def _ip(pid: int, *words: str) -> None:
    """Run `ip` in the namespace of a process."""
    command = ["nsenter", f"--net={_path(pid)}", "ip", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(words)}: {done.stderr}"


def _path(pid: int) -> str:
    return f"/proc/{pid}/ns/net"
