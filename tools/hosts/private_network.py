"""A network namespace of a host's own services: nobody else there reaches its CAN interfaces.

A raw CAN socket needs no privilege, so whoever may log in to a host could idle a drive. Interfaces
that are moved into the namespace are seen by the services alone. They talk to the other hosts by a
macvlan on the robot's network, which has the host's `address` there. Pure: text from text.
"""

from __future__ import annotations

import shlex
from typing import Final

from tools.bringup.check_socketcan import setup_commands
from tools.hosts.hosts_file import Host

NAMESPACE: Final = "xrl"
UNIT: Final = "xrl-net.service"
PATH: Final = f"/run/netns/{NAMESPACE}"
_LINK: Final = "xrl0"
_IP: Final = "/sbin/ip"


def set_up_commands(host: Host) -> list[list[str]]:
    """Return the commands, for root, that make the namespace and move the interfaces into it."""
    inside = [_IP, "-n", NAMESPACE]
    commands = [
        [_IP, "netns", "add", NAMESPACE],
        [*inside, "link", "set", "lo", "up"],
        [_IP, "link", "add", _LINK, "link", host.nic, "netns", NAMESPACE,
         "type", "macvlan", "mode", "bridge"],
        [*inside, "address", "add", f"{host.address}/{host.prefix}", "dev", _LINK],
        [*inside, "link", "set", _LINK, "up"],
    ]  # fmt: skip
    for name in host.private:
        commands += move_commands(name)
    return commands


def move_commands(name: str) -> list[list[str]]:
    """Return the commands that move one CAN interface into the namespace and bring it up there."""
    up = [[_IP, "-n", NAMESPACE, *words[1:]] for words in setup_commands(name)]
    return [[_IP, "link", "set", name, "netns", NAMESPACE], *up]


def tear_down_command() -> list[str]:
    """Return the command that takes the namespace's name away."""
    return [_IP, "netns", "delete", NAMESPACE]


def unit(host: Host) -> str:
    """Return the systemd unit that has the namespace made before the services start.

    When it is stopped its name goes, and with the last process in it the namespace: an adapter is
    then the host's again.
    """
    starts = "\n".join(f"ExecStart={shlex.join(words)}" for words in set_up_commands(host))
    end = shlex.join(tear_down_command())
    return f"""\
# Made by `xrl hosts`; what it is for stands in docs/hosts.md.
[Unit]
Description=Extra Robotic Legs: {", ".join(host.private)} for the services alone
After=network-online.target
Wants=network-online.target

[Service]
Type=oneshot
RemainAfterExit=yes
ExecStartPre=-{end}
{starts}
ExecStop={end}
"""
