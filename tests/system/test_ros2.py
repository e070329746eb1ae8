"""A live fleet, seen and stopped by a node of ROS 2 that is not the project's."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from shared.bus.messages import Mode
from shared.joints import JOINTS, MODULES
from shared.places import DEFAULT_CONFIG
from tests.system.fleets import wait_for, xrl
from tests.system.ros2_network import OtherNode, free_port, router, session

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(180)]

DOMAIN = 37


def robot_file(folder: Path, port: int) -> Path:
    path = folder / "robot.toml"
    text = DEFAULT_CONFIG.read_text(encoding="utf-8")
    path.write_text(f'{text}\n[ros2]\nrouter = "tcp/127.0.0.1:{port}"\n', encoding="utf-8")
    shutil.copy(DEFAULT_CONFIG.with_suffix(".gains.json"), folder / "robot.gains.json")
    return path


def test_a_node_of_another_finds_the_robot_reads_it_all_leads_it_a_little_and_stops_it(
    run_dir: Path, tmp_path: Path
) -> None:
    port = free_port()
    asked = ("--config", robot_file(tmp_path, port), "--domain", str(DOMAIN))
    up = xrl("up", *asked, "--out", tmp_path / "run", "--ros2", "--accept", "intent,estop",
             "--scenario", "squat", run_dir=run_dir)  # fmt: skip
    assert up.returncode == 0, up.stderr
    try:
        absent = xrl("ros2", "check", *asked, "--wait", "1")
        assert absent.returncode == 3, "the router comes later"
        assert "does not answer" in absent.stdout
        with router(port), session("peer", connect__endpoints=[f"tcp/127.0.0.1:{port}"]) as opened:
            node = OtherNode(opened, DOMAIN)
            assert wait_for(lambda: len(node.topics()) == 6)
            for topic, row in node.topics().items():
                assert row["node_name"] == "xrl"
                name = row["dds_type"].replace("::dds_::", "/").replace("::", "/").rstrip("_")
                node.subscribe(topic, name, late=topic == "/robot_description")
            assert wait_for(lambda: len(node.received) == 6)
            assert wait_for(lambda: len(node.received["/joint_states"]) > 100)
            joints = node.received["/joint_states"][-1]
            assert tuple(joints.name) == JOINTS
            assert len(set(joints.position)) == len(JOINTS)
            assert node.received["/robot_description"][0].data.startswith("<robot")
            numbers = [row.sequence_id for row in node.attachments["/joint_states"]]
            assert numbers == sorted(set(numbers)), "each once, in order"
            assert wait_for(lambda: _says(node, "knee_left", "TRACK"))
            assert _says(node, "planner", "LEADING")

            found = xrl("ros2", "check", *asked)
            assert found.returncode == 0, found.stdout
            assert "12 of 12 joints" in found.stdout

            def asks() -> bool:
                node.publish("/xrl/intent", "std_msgs/msg/Float64", data=30.0)
                rows = {row.name: row for row in node.received["/diagnostics"][-1].status}
                given = {pair.key: pair.value for pair in rows["xrl: planner"].values}
                return float(given.get("assist, N", 0.0)) > 20.0

            assert wait_for(asks), "the planner gives the assist that is asked for"
            node.publish("/xrl/estop", "std_msgs/msg/Bool", data=False)
            node.publish("/xrl/estop", "std_msgs/msg/Bool", data=True)
            assert wait_for(lambda: all(
                _says(node, name, Mode.DAMP.name)
                for name in MODULES
            ))  # fmt: skip
    finally:
        down = xrl("down", run_dir=run_dir)
    assert down.returncode == 0, down.stderr


def _says(node: OtherNode, name: str, word: str) -> bool:
    rows = {row.name: row.message for row in node.received["/diagnostics"][-1].status}
    return rows[f"xrl: {name}"].startswith(word)
