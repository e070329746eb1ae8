"""`xrl log export --ros2bag`: a bag that other programs read, with what the log says."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from services.ros2_gateway.gateway import topics_of
from shared.bus import topics
from shared.bus.messages import JointState, PlannerStatus
from shared.joints import JOINTS, MODULES
from tests.ros2_gateway.others import TYPES, read
from tests.shared.mcap_log.runs import recorded_in_parts
from tools import cli
from tools.logs.run_log import read_run

KNOWN = topics_of("")


@pytest.fixture(scope="module")
def bag(run_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bag") / "bag"
    assert cli.main(["log", "export", str(run_file), "--ros2bag", str(out), "--rate", "50"]) == 0
    return out


def test_rosbags_reads_every_message(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        counts = {row.topic: row.msgcount for row in reader.connections}
        for connection, _, payload in reader.messages():
            reader.deserialize(payload, connection.msgtype)
    assert counts[KNOWN.joint_states.name] == counts[KNOWN.tf.name] > 100
    assert counts[KNOWN.description.name] == 1


def test_it_is_an_mcap_of_ros_2_whose_bytes_another_implementation_would_write(bag: Path) -> None:
    found: dict[str, list[Any]] = defaultdict(list)
    with (bag / "bag.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            found[channel.topic].append(read(schema.name, message.data))
    assert set(found) == {topic.name for topic in KNOWN if topic != KNOWN.clock}
    assert {type(row).get_type_name() for rows in found.values() for row in rows} <= set(TYPES)


def test_a_joint_state_is_the_newest_state_of_each_module_at_its_time(
    bag: Path, run_file: Path
) -> None:
    log = read_run(run_file)
    states: dict[str, list[JointState]] = {
        name: log.messages(topics.JOINT_STATE, name) for name in MODULES
    }
    compared = 0
    with AnyReader([bag]) as reader:
        chosen = [row for row in reader.connections if row.topic == KNOWN.joint_states.name]
        for _, unix_ns, payload in reader.messages(chosen):
            message = read(KNOWN.joint_states.type, bytes(payload))
            at_ns = unix_ns - log.offset_ns
            stamp = message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == unix_ns
            if tuple(message.name) != JOINTS:
                continue  # a drive without a sample yet
            position = dict(zip(message.name, message.position, strict=True))
            for module, rows in states.items():
                shown = (position[f"{module}_phi"], position[f"{module}_theta"])
                near = [row for row in rows if at_ns - 9_000_000 <= row.t_ns <= at_ns]
                assert shown in [row.q for row in near]
                compared += 1
    assert compared > 500


def test_when_the_planner_is_dead_the_diagnostics_say_so(bag: Path, run_file: Path) -> None:
    statuses: list[PlannerStatus] = read_run(run_file).messages(topics.PLANNER_STATUS)
    offset_ns = read_run(run_file).offset_ns
    said = []
    with AnyReader([bag]) as reader:
        chosen = [row for row in reader.connections if row.topic == KNOWN.diagnostics.name]
        for _, unix_ns, payload in reader.messages(chosen):
            rows = {row.name: row for row in read(KNOWN.diagnostics.type, bytes(payload)).status}
            dead = unix_ns - offset_ns - statuses[-1].t_ns > 600_000_000
            if dead:
                said.append(rows["xrl: planner"].message)
    assert said
    assert set(said) == {"silent: each module holds on its own"}


def test_a_run_after_2038_is_refused_as_a_bag_and_has_its_other_exports(
    run_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In 2510 also 32-bit seconds are over."""
    log = read_run(run_file)
    log.offset_ns += 540 * 365 * 86_400 * 10**9
    log.metadata["clock"]["offset_ns"] = str(log.offset_ns)
    path = recorded_in_parts(log, tmp_path / "late")
    bag = tmp_path / "bag"
    assert cli.main(["log", "export", str(path), "--ros2bag", str(bag)]) == 2
    assert "are outside the range of ROS 2, which ends on 2038-01-19" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [path]
    words = ["--csv", str(tmp_path / "tables")]
    assert cli.main(["log", "export", str(path), *words]) == 0
