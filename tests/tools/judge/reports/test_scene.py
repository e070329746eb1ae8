"""The 3-D scene and the record's schemas, compared with the models and by other readers."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from foxglove import Channel, Context, open_mcap
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from shared.arrays import Array
from shared.bus import codec, topics
from shared.config.robot_config import RobotConfig
from shared.joints import JOINTS, MODULES, SIDES
from shared.mcap_log import schema
from shared.robot.frames import UPRIGHT, FramePose
from shared.robot.robot_model import ankle_positions, mjcf
from tests.shared.mcap_log.runs import sample
from tests.shared.mcap_log.test_schema import fits
from tests.tools.judge.reports import runs
from tests.tools.judge.reports.runs import Made
from tools.judge.reports import foxglove, scene
from tools.judge.reports.foxglove import Arrow, Entity, Solid
from tools.judge.reports.scene import RobotPose
from tools.logs.run_log import RunLog

BODIES = {"hip": "thigh", "knee": "shin", "ankle": "foot"}


@pytest.fixture(scope="module")
def poses(log: RunLog, robot: RobotConfig) -> list[RobotPose]:
    return list(scene.poses(log, robot))


def matrix(turn: tuple[float, float, float, float]) -> Array:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.array(turn)[[3, 0, 1, 2]])
    return out.reshape(3, 3)


def in_world(frames: list[FramePose]) -> dict[str, tuple[Array, Array]]:
    """Return (position, rotation) of each frame in the world."""
    found = {"world": (np.zeros(3), np.eye(3))}
    for row in frames:
        r, R = found[row.parent]
        found[row.child] = (r + R @ np.array(row.position), R @ matrix(row.rotation))
    return found


@pytest.fixture(scope="module")
def model(robot: RobotConfig) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(mjcf(robot))


def bodies(
    model: mujoco.MjModel, torso: Any, angles: Any, q: Any
) -> dict[str, tuple[Array, Array]]:
    """Return the position and rotation of each frame in MuJoCo."""
    data = mujoco.MjData(model)
    roll, pitch, yaw = angles
    turn = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
    for axis, angle in ((1, roll), (2, pitch)):
        step = np.zeros(4)
        step[0], step[axis] = math.cos(angle / 2), math.sin(angle / 2)
        mujoco.mju_mulQuat(turn, turn.copy(), step)
    data.qpos[:3], data.qpos[3:7] = torso, turn
    for name, angle in zip(JOINTS, q, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    names = {f"{kind}_{side}": f"{BODIES[kind]}_{side}" for kind in BODIES for side in SIDES}
    found = {
        frame: (data.body(body).xpos.copy(), data.body(body).xmat.reshape(3, 3).copy())
        for frame, body in (names | {"torso": "torso"}).items()
    }
    found["harness"] = (data.site("harness").xpos.copy(), found["torso"][1])
    return found


def deviation(found: Any, right: Any) -> float:
    return max(
        np.abs(a - b).max() for name in right for a, b in zip(found[name], right[name], strict=True)
    )


def test_the_frames_are_those_of_the_model_at_random_times(
    poses: list[RobotPose], log: RunLog, robot: RobotConfig, model: mujoco.MjModel
) -> None:
    dice = random.Random(3)
    for pose in dice.sample(poses, 25):
        t_ns = pose.t_ns
        truth = next(row for row in log.messages(topics.SIM_TRUTH) if row.t_ns == t_ns)
        q = [
            angle
            for module in MODULES
            for angle in [
                row.q for row in log.messages(topics.JOINT_STATE, module) if row.t_ns <= t_ns
            ][-1]
        ]
        right = bodies(model, truth.torso, truth.angles, q)
        found = in_world(scene.frames(robot, pose))
        assert deviation(found, right) < 1e-9
        assert found["com"][0].tolist() == list(truth.com)
        assert set(found) == {"world", "torso", "com", "harness", *MODULES}


@given(st.lists(st.floats(-3.0, 3.0), min_size=18, max_size=18))
def test_the_frames_are_those_of_the_model_in_any_pose(
    robot: RobotConfig, model: mujoco.MjModel, numbers: list[float]
) -> None:
    torso, angles, q = tuple(numbers[:3]), tuple(numbers[3:6]), tuple(numbers[6:])
    nothing = (0.0, 0.0, 0.0)
    pose = RobotPose(0, torso, angles, nothing, q, (0,) * 6, nothing, nothing)
    assert deviation(in_world(scene.frames(robot, pose)), bodies(model, torso, angles, q)) < 1e-9


def test_the_bodies_are_those_of_the_model(robot: RobotConfig, model: mujoco.MjModel) -> None:
    found = {entity.name: entity for entity in scene.links(robot)}
    for name, form in (("torso", "cube"), ("sole_left", "cube"), ("shin_right", "cylinder")):
        (solid,) = found[name].solids
        geom = model.geom(name)
        half = geom.size if form == "cube" else [geom.size[0], geom.size[0], geom.size[1]]
        assert solid.shape == form
        assert solid.size == pytest.approx(2 * np.array(half))
        assert solid.position == pytest.approx(geom.pos)


def test_the_scene_comes_at_30_hz_and_shows_modes_and_forces(poses: list[RobotPose]) -> None:
    seconds = (poses[-1].t_ns - poses[0].t_ns) / 1e9
    assert len(poses) / seconds == pytest.approx(30.0, rel=0.02)
    colours = set()
    arrows = 0
    for pose in poses:
        found = {entity.name: entity for entity in scene.state(pose)}
        colours.add(found["module_ankle_right"].solids[0].colour)
        for arrow in found["operator"].arrows:
            arrows += 1
            assert arrow.length > 0.009
    assert {scene.MODES[1], scene.MODES[2]} <= colours
    assert arrows > 5


@given(st.tuples(*[st.floats(-10.0, 10.0)] * 3).filter(lambda v: math.hypot(*v) > 1e-3))
def test_an_arrow_points_along_its_force(force: tuple[float, float, float]) -> None:
    R = matrix(scene.rotation_to(force))
    assert np.abs(R[:, 0] - np.array(force) / math.hypot(*force)).max() < 1e-7


def test_without_a_simulated_world_the_robot_stands_on_its_feet(
    log: RunLog, robot: RobotConfig
) -> None:
    real = runs.changed(log, keep=lambda name: not name.startswith("sim/"))
    poses = list(scene.poses(real, robot))
    ankles = dict(zip(SIDES, ankle_positions(robot), strict=True))
    for pose in poses[:: len(poses) // 20]:
        found = in_world(scene.frames(robot, pose))
        for side in SIDES:
            assert (
                np.abs(found[f"ankle_{side}"][0] - ankles[side]).max() < 0.015
            )  # drivetrains stretch
            assert found[f"ankle_{side}"][1][2, 2] > 0.99


def test_every_payload_of_every_channel_fits_its_schema(made: Made) -> None:
    """PlotJuggler and Foxglove read a channel by its schema alone."""
    checked = set()
    with made.path.open("rb") as file:
        for described, channel, message in make_reader(file).iter_messages():
            assert described is not None
            checked.add(described.name)
            assert (described.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert fits(json.loads(message.data), json.loads(described.data)), channel.topic
    assert "xrl.JointState" in checked


def numbers(message: Any, names: str) -> tuple[float, ...]:
    return tuple(getattr(message, name) for name in names)


def solids(entity: Any) -> tuple[Solid, ...]:
    found = []
    for form in ("cube", "cylinder", "sphere"):
        for shape in getattr(entity, f"{form}s"):
            assert numbers(shape.pose.orientation, "xyzw") == UPRIGHT
            if form == "cylinder":
                assert (shape.bottom_scale, shape.top_scale) == (1.0, 1.0)
            size, at = numbers(shape.size, "xyz"), numbers(shape.pose.position, "xyz")
            found.append(Solid(form, size, numbers(shape.color, "rgba"), at))
    return tuple(found)


def arrows(entity: Any) -> tuple[Arrow, ...]:
    return tuple(
        Arrow(
            numbers(arrow.pose.position, "xyz"),
            numbers(arrow.pose.orientation, "xyzw"),
            pytest.approx(arrow.shaft_length + arrow.head_length),
            arrow.shaft_diameter,
            numbers(arrow.color, "rgba"),
        )
        for arrow in entity.arrows
    )


def test_another_reader_of_protobuf_finds_all_frames_and_bodies_of_the_scene(
    poses: list[RobotPose], robot: RobotConfig, tmp_path: Path
) -> None:
    """The reader uses only the schemas in the file."""
    context, path, ns = Context(), tmp_path / "scene.mcap", 1_700_000_000_123_456_789
    with open_mcap(path, context=context):
        frames, bodies = (
            Channel(name, schema=schema, message_encoding=foxglove.ENCODING, context=context)
            for name, schema in (
                ("frames", foxglove.transforms_schema()), ("bodies", foxglove.scene_schema()),
            )
        )  # fmt: skip
        for pose in poses[::10]:
            frames.log(foxglove.transforms(ns, scene.frames(robot, pose)), log_time=ns)
            bodies.log(foxglove.scene(ns, scene.state(pose)), log_time=ns)
        bodies.log(foxglove.scene(ns, scene.links(robot)), log_time=ns)
    found: dict[str, list[Any]] = {"frames": [], "bodies": []}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(log_time_order=False):
            rows = message.transforms if channel.topic == "frames" else message.entities
            assert {one.timestamp.ToNanoseconds() for one in rows} == {ns}
            found[channel.topic].append(rows)
    for pose, rows in zip(poses[::10], found["frames"], strict=True):
        assert scene.frames(robot, pose) == [
            FramePose(
                row.parent_frame_id, row.child_frame_id,
                numbers(row.translation, "xyz"), numbers(row.rotation, "xyzw"),
            )
            for row in rows
        ]  # fmt: skip
    wanted = [scene.state(pose) for pose in poses[::10]] + [scene.links(robot)]
    for entities, rows in zip(wanted, found["bodies"], strict=True):
        assert all(row.frame_locked and not row.lifetime.ToNanoseconds() for row in rows)
        assert entities == [Entity(row.frame_id, row.id, solids(row), arrows(row)) for row in rows]


def test_foxgloves_own_library_accepts_every_schema(tmp_path: Path) -> None:
    context = Context()
    path = tmp_path / "theirs.mcap"
    with open_mcap(path, context=context):
        for topic in topics.TOPICS:
            text = json.loads(schema.encoded(topic.type))
            channel = Channel(topic.name, schema=text, context=context)
            channel.log(json.loads(codec.encode(sample(topic.type))))
    with path.open("rb") as file:
        assert make_reader(file).get_summary() is not None
