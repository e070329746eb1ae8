"""The rules by which only a robot's hosts reach its ports, in a network namespace of the test's."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.config.sections import BusSecurityConfig
from tools.hosts import layout

NAMESPACE = ("unshare", "--user", "--map-root-user", "--net")
REACHES = """
import socket, subprocess, sys
subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
subprocess.run(["nft", "-f", sys.argv[1]], check=True)
subprocess.run(["nft", "-f", sys.argv[1]], check=True)  # again, as after a restart
for port, source in (word.split("@") for word in sys.argv[2:]):
    family = socket.AF_INET6 if ":" in source else socket.AF_INET
    with socket.socket(family) as listener, socket.socket(family) as one:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("::1" if ":" in source else "127.0.0.1", int(port)))
        listener.listen()
        one.bind((source, 0))
        one.settimeout(0.3)
        print(one.connect_ex(listener.getsockname()[:2]) == 0)
"""


def test_only_the_robots_hosts_and_allowed_addresses_reach_its_ports(
    robot: RobotConfig, tmp_path: Path
) -> None:
    if not shutil.which("nft") or subprocess.run([*NAMESPACE, "true"], check=False).returncode:
        pytest.skip("no nft, or no network namespaces for this user")
    endpoints = {"planner": "tls/127.0.0.2:7447", "recorder": "tls/127.0.0.3:7448"}
    security = BusSecurityConfig("mtls", "/keys", ("127.0.0.9", "::1"))
    bus = msgspec.structs.replace(robot.bus, endpoints=endpoints, security=security)
    rules = tmp_path / "xrl.nft"
    rules.write_text(layout.firewall(msgspec.structs.replace(robot, bus=bus)), encoding="utf-8")
    tried = {
        "7447@127.0.0.2": True, "7448@127.0.0.2": True, "7447@127.0.0.9": True, "7447@::1": True,
        "7447@127.0.0.66": False, "7448@127.0.0.66": False, "8000@127.0.0.66": True,
    }  # fmt: skip
    words = [*NAMESPACE, sys.executable, "-c", REACHES, str(rules), *tried]
    said = subprocess.run(words, check=True, capture_output=True, text=True, timeout=60).stdout
    assert dict(zip(tried, said.split(), strict=True)) == {k: str(v) for k, v in tried.items()}
