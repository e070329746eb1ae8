"""The switch of `tests.system.namespaces`: a process in a network namespace of its own.

It speaks netlink by pyroute2, which forks to enter another namespace; so it is a small process
without threads and signal handlers. A line on its input is a list of orders in JSON, and is
answered by a line: `null`, or what was wrong. Orders are

    ["join", HOST, PROCESS_ID, ADDRESS]
    ["set", HOST, "plugged" | "forwarded", true | false]

It ends, and the switch with it, at the end of its input.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any, Final

from pyroute2 import IPRoute
from pyroute2.netlink.exceptions import NetlinkError

_BRIDGE: Final = "switch"
_CARD: Final = "eth0"
"""Every host's network card."""


class Switch:
    """A bridge in this process's own namespace."""

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
    """Serve until the end of the input."""
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
