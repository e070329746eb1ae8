"""Hosts, ports and placeholders of endpoints."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.config.endpoints import filled, host_and_port, is_endpoint, stray_braces
from shared.config.robot_config import expand
from shared.exceptions import BusError
from shared.run_directory import live_dir


@pytest.mark.parametrize(
    ("endpoint", "found"),
    [
        ("tcp/legs:7447", ("legs", 7447)),
        ("tls/10.0.0.1:1", ("10.0.0.1", 1)),
        ("tls/[::1]:65535", ("::1", 65535)),
        ("tcp/[fe80::1%eth0]:7447", ("fe80::1%eth0", 7447)),
        ("tcp/legs:7447?prio=1#x", ("legs", 7447)),
    ],
)
def test_host_and_port_are_found(endpoint: str, found: tuple[str, int]) -> None:
    assert host_and_port(endpoint) == found


@given(st.integers())
def test_a_port_is_from_1_to_65535(port: int) -> None:
    assert is_endpoint(f"tcp/legs:{port}") is (1 <= port <= 65_535)


@pytest.mark.parametrize(
    "endpoint", ["tcp/legs", "tcp/:7447", "tcp/::1:7447", "udp/legs:7447", "tcp/legs:\u0664", ""]
)
def test_what_is_no_host_and_port_is_refused(endpoint: str) -> None:
    assert not is_endpoint(endpoint)
    with pytest.raises(BusError, match="tcp/HOST:PORT is right, a port from 1 to 65535"):
        host_and_port(endpoint)


def test_a_placeholder_is_filled_in_once_whatever_it_is_filled_with() -> None:
    assert filled("{a}/{b}/{c}", {"{a}": "{b}", "{b}": "2"}) == "{b}/2/{c}"
    run_dir = Path("/tmp/{run}")
    assert expand("unixsock-stream/{run}/x", run_dir) == f"unixsock-stream/{live_dir(run_dir)}/x"
    assert expand("tcp/10.0.0.1:7447", Path("/tmp")) == "tcp/10.0.0.1:7447"


@pytest.mark.parametrize(
    ("text", "stray"),
    [("{run}/a/{run}", ""), ("{Run}/a", "{Run}"), ("{run/a", "{run/a"), ("run}/a", "}"),
     ("{}/a", "{}"), ("{ru{run}n}", "{run}")],
)  # fmt: skip
def test_braces_that_nothing_is_filled_into_are_found_and_refused(text: str, stray: str) -> None:
    assert stray_braces(text, ["{run}"]) == stray
    if stray:
        with pytest.raises(BusError, match=r"is no placeholder; only \{run\} is filled in"):
            expand(text, Path("/tmp"))


@pytest.mark.parametrize("path", ["/tmp/a?b", "/tmp/a#b", "/tmp/a #b"])
def test_a_socket_path_that_the_bus_would_take_apart_is_no_endpoint(path: str) -> None:
    assert not is_endpoint(f"unixsock-stream/{path}")
    assert is_endpoint(f"unixsock-stream/{re.sub('[?#]', '', path)} 50% ;")
