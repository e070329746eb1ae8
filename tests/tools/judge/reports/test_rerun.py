"""Exported log in Rerun: transforms in protobuf, and bodies as URDF.

Rerun reads transforms only from `foxglove.FrameTransforms` in protobuf, and URDF from a
`std_msgs/msg/String` whose topic ends in `robot_description` (tested with rerun-sdk 0.41).
The tests read the model with Pinocchio's URDF reader.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from mcap.reader import make_reader

from shared.config.robot_config import RobotConfig
from tests.tools.judge.reports.runs import Made
from tools import cli
from tools.judge.reports import scene, urdf
from tools.judge.reports.foxglove import Entity, Solid
from tools.judge.reports.scene import RobotPose
from tools.logs.run_log import RunLog

SIZES: dict[str, Callable[[pin.GeometryObject], list[float]]] = {
    "cube": lambda body: list(2 * body.geometry.halfSide),
    "cylinder": lambda body: [2 * body.geometry.radius] * 2 + [2 * body.geometry.halfLength],
    "sphere": lambda body: [2 * body.geometry.radius] * 3,
}


@pytest.fixture(scope="module")
def shown(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("rerun") / "shown.mcap"
    assert cli.main(["log", "export", str(made.path), "--scene", "-o", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def first(log: RunLog, robot: RobotConfig) -> RobotPose:
    return next(scene.poses(log, robot))


@pytest.fixture(scope="module")
def model(robot: RobotConfig, first: RobotPose) -> str:
    return scene.model("lab", robot, first)


def test_the_model_comes_once_before_the_transforms_on_the_topic_for_rerun(
    shown: Path, log: RunLog, robot: RobotConfig, first: RobotPose
) -> None:
    with shown.open("rb") as file:
        rows = list(make_reader(file).iter_messages(log_time_order=False))
    topics = [row[1].topic for row in rows]
    (place,) = [n for n, topic in enumerate(topics) if topic.endswith("robot_description")]
    assert place < topics.index("xrl/xrl/scene/frames")
    described, channel, message = rows[place]
    assert described is not None
    assert (described.name, described.encoding) == ("std_msgs/msg/String", "ros2msg")
    assert channel.message_encoding == "cdr"
    assert message.log_time == first.t_ns + log.offset_ns
    text = scene.model("xrl", robot, first).encode() + b"\0"
    assert message.data == b"\x00\x01\x00\x00" + len(text).to_bytes(4, "little") + text


def test_the_links_form_the_tree_of_the_frames(
    model: str, robot: RobotConfig, first: RobotPose
) -> None:
    tree = pin.buildModelFromXML(model)
    assert tree.name == "lab"
    frames = scene.frames(robot, first)
    links = {frame.name for frame in tree.frames if frame.type == pin.FrameType.BODY}
    assert links == {"world", *(row.child for row in frames)}
    for row in frames:
        joint = tree.getJointId(f"to_{row.child}")
        assert tree.joints[joint].shortname() == "JointModelFreeFlyer"
        above = tree.parents[joint]
        assert tree.names[above] == ("universe" if row.parent == "world" else f"to_{row.parent}")


def test_the_bodies_of_the_model_are_those_of_the_scene(
    model: str, robot: RobotConfig, first: RobotPose
) -> None:
    tree = pin.buildModelFromXML(model)
    found = pin.buildGeomFromUrdfString(tree, model, pin.GeometryType.VISUAL).geometryObjects
    bodies = {body.name: body for body in found}  # by link and number
    count: Counter[str] = Counter()
    for entity in (*scene.links(robot), *scene.state(first)):
        for solid in entity.solids:
            body = bodies.pop(f"{entity.frame}_{count[entity.frame]}")
            count[entity.frame] += 1
            assert tree.frames[body.parentFrame].name == entity.frame
            assert SIZES[solid.shape](body) == pytest.approx(solid.size)
            assert body.placement.translation == pytest.approx(np.array(solid.position))
            assert body.placement.rotation == pytest.approx(np.eye(3))
            colour = scene.UNKNOWN if entity.name.startswith("module_") else solid.colour
            assert body.meshColor == pytest.approx(np.array(colour))
    assert not bodies
    assert count.total() == 14


def test_names_with_xml_characters_are_kept(robot: RobotConfig, first: RobotPose) -> None:
    name = 'a<b>&"c'
    solid = Solid("sphere", (0.1, 0.1, 0.1), (1.0, 0.0, 0.0, 1.0))
    text = urdf.urdf(name, scene.frames(robot, first), [Entity("torso", name, (solid,))])
    assert pin.buildModelFromXML(text).name == name
