"""The services' own network: who else is on the host does not see its CAN interfaces."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from tests.system.namespaces import isolation
from tests.tools.hosts.places import complaints_about, make_hosts
from tools.hosts import hosts_file, installation, layout
from tools.hosts.hosts_file import Host, Hosts
from tools.hosts.remote import Remote

IN_A_MACHINE_OF_ITS_OWN = """
mount -t tmpfs none /run
ip link set lo up
ip link add eth0 type veth peer name far0
ip link add can0 type veth peer name drive0
unshare --net sleep 600 &
export BODY=$!
trap "kill $BODY" EXIT
while [ "$(readlink /proc/$BODY/ns/net)" = "$(readlink /proc/self/ns/net)" ]; do sleep 0.02; done
ip link set far0 netns $BODY
nsenter --net=/proc/$BODY/ns/net sh -c 'ip link set lo up; ip addr add 10.0.0.1/24 dev far0;
  ip link set far0 up'
ip link set eth0 up; ip link set drive0 up
"$1" -c "$2" "$3"
"""
COMMANDS = """
import json, os, subprocess, sys
commands, leaving = json.loads(sys.argv[1])
def run(words): return subprocess.run(words, check=True, capture_output=True, text=True).stdout
def links(*words): return [row["ifname"] for row in json.loads(run(["ip", *words, "-j", "link"]))]
for words in commands:  # twice, and with an adapter that is not there
    subprocess.run(words, capture_output=True)
inside = ["ip", "netns", "exec", "xrl"]
listens = "import socket as s; x=s.create_server(('10.0.0.2',7447)); print(flush=True); x.accept()"
there = subprocess.Popen([*inside, sys.executable, "-c", listens], stdout=subprocess.PIPE)
there.stdout.readline()
try:
    body = ["nsenter", f"--net=/proc/{os.environ['BODY']}/ns/net"]
    dial = "import socket; socket.create_connection(('10.0.0.2', 7447), timeout=5)"
    dialled = subprocess.run([*body, sys.executable, "-c", dial]).returncode == 0
finally:
    there.kill()
    there.wait()
found = {"inside": links("-n", "xrl"), "outside": links(), "dialled": dialled}
run(leaving)
print(json.dumps({**found, "left": run(["ip", "netns", "list"])}))
"""


@pytest.fixture
def hosts(short_dir: Path, robot: RobotConfig) -> Hosts:
    return hosts_file.load(make_hosts(short_dir / "h"), robot)


@pytest.fixture
def host(hosts: Hosts) -> Host:
    return msgspec.structs.replace(hosts.host[1], address="10.0.0.2", private=("can0",), nic="eth0")


@pytest.mark.system
@pytest.mark.skipif(shutil.which("ip") is None, reason="no ip on this machine")
def test_in_it_are_the_can_interfaces_and_the_hosts_address_and_outside_is_neither(
    host: Host,
) -> None:
    """On links of another kind: this machine's kernel may have no CAN."""
    words, refusal = isolation()
    if refusal:
        pytest.skip(refusal)
    of_can_alone = ("bitrate", "txqueuelen")
    commands = [row for row in layout.set_up_commands(host) if not set(of_can_alone) & {*row}]
    missing = layout.move_commands("can1")[:1]
    given = json.dumps([[*commands, *missing, *commands], layout.tear_down_command()])
    done = subprocess.run(
        [*words, "--mount", "bash", "-c", IN_A_MACHINE_OF_ITS_OWN, "-", sys.executable, COMMANDS,
         given],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert set(found["inside"]) == {"lo", "xrl0", "can0"}
    assert "can0" not in found["outside"]
    assert found["dialled"], "another host reaches a service in it by the host's address"
    assert found["left"] == ""


def test_its_can_interfaces_are_set_up_as_without_it(host: Host) -> None:
    inside = [" ".join(words) for words in layout.move_commands("can0")]
    assert inside[0] == "/sbin/ip link set can0 netns xrl"
    assert "/sbin/ip -n xrl link set can0 up type can bitrate 1000000 restart-ms 100" in inside


def test_the_services_wait_for_it_and_start_in_it(
    hosts: Hosts, host: Host, robot: RobotConfig
) -> None:
    text = layout.unit(hosts, host)
    files = installation.files_of(hosts, host, robot, b"{}", None)
    assert "NetworkNamespacePath=/run/netns/xrl\n" in text
    assert "Wants=xrl-net.service\n" in text
    assert "Requires" not in text, "whoever stops it is not to idle the drives"
    assert any(file.path.endswith("/xrl-net.service") for file in files)
    plain = msgspec.structs.replace(host, private=(), nic="")
    assert "netns" not in layout.unit(hosts, plain)
    if shutil.which("ip") is None:
        return
    with pytest.raises(FleetError, match="network namespace"):  # there is none here
        Remote(hosts, host).run("true", on_bus=True)


def test_systemd_takes_its_unit(host: Host, tmp_path: Path) -> None:
    unit = tmp_path / layout.NETWORK_UNIT
    unit.write_text(layout.network_unit(host).replace("/sbin/ip", "/bin/true"), encoding="utf-8")
    assert complaints_about(unit) == []
