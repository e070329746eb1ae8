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
SERVICES_UNIT: Final = "xrl.service"
PATH: Final = f"/run/netns/{NAMESPACE}"
LINK: Final = "xrl0"
"""The services' interface on the robot's network."""
IP: Final = "/sbin/ip"


def set_up_commands(host: Host) -> list[list[str]]:
    """Return the commands, for root, that make the namespace and move the interfaces into it.

    Each does its part or fails alone, and done twice they do nothing: the CAN interfaces, which a
    leg stands by, come before the network.
    """
    inside = [IP, "-n", NAMESPACE]
    commands = [[IP, "netns", "add", NAMESPACE], [*inside, "link", "set", "lo", "up"]]
    for name in host.private:
        commands += move_commands(name)
    duplicates = ["nodad"] if ":" in host.address else []
    return [
        *commands,
        [IP, "link", "add", LINK, "link", host.nic, "netns", NAMESPACE,
         "type", "macvlan", "mode", "bridge"],
        [*inside, "address", "add", f"{host.address}/{host.prefix}", "dev", LINK, *duplicates],
        [*inside, "link", "set", LINK, "up"],
    ]  # fmt: skip


def move_commands(name: str) -> list[list[str]]:
    """Return the commands that move one CAN interface into the namespace and bring it up there."""
    up = [[IP, "-n", NAMESPACE, *words[1:]] for words in setup_commands(name)]
    return [[IP, "link", "set", name, "netns", NAMESPACE], *up]


def tear_down_command() -> list[str]:
    """Return the command that takes the namespace's name away."""
    return [IP, "netns", "delete", NAMESPACE]


def unit(host: Host) -> str:
    """Return the systemd unit that has the namespace made before the services start.

    It does nothing while services run: a second namespace would have the address of theirs.
    """
    starts = "\n".join(f"ExecStart=-{shlex.join(words)}" for words in set_up_commands(host))
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
ExecCondition=/bin/sh -c '! systemctl --quiet is-active {SERVICES_UNIT}'
# Each may fail: one adapter that is missing is not to take the others with it.
{starts}
ExecStop=/bin/sh -c 'systemctl --quiet is-active {SERVICES_UNIT} || {end}'
"""
