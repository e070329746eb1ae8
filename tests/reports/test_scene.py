"""`xrl export`: the 3-D scene and the layout, held against the models and the schemas."""

from __future__ import annotations

import json
import math
import random
import re
from collections import Counter
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from numpy.typing import NDArray

from services.recorder import schema
from shared import codec, topics
from shared.config import RobotConfig
from shared.joints import JOINTS, MODULES, SIDES
from shared.robot_model import ankle_positions, mjcf
from tests.recorder.runs import sample
from tests.recorder.test_schema import fits
from tests.reports import runs
from tests.reports.runs import Made
from tools import cli
from tools.export import LAYOUT, export_scene, layout_for
from tools.reports import foxglove, scene
from tools.runs.run_log import RunLog, read_run

Array = NDArray[np.float64]
BODIES = {"hip": "thigh", "knee": "shin", "ankle": "foot"}


@pytest.fixture(scope="module")
def shown(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("shown") / "shown.mcap"
    assert cli.main(["export", str(made.path), "--scene", "-o", str(out)]) == 0
    return out


def payloads(path: Path, topic: str) -> list[tuple[int, Any]]:
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(topics=[topic])
        return [(message.log_time, json.loads(message.data)) for _, _, message in found]


def matrix(rotation: dict[str, float]) -> Array:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.array([rotation[k] for k in "wxyz"]))
    return out.reshape(3, 3)


def in_world(transforms: list[dict[str, Any]]) -> dict[str, tuple[Array, Array]]:
    """Return (position, rotation) of each frame, chained from the world on."""
    found = {"world": (np.zeros(3), np.eye(3))}
    for row in transforms:
        r, R = found[row["parent_frame_id"]]
        at = np.array([row["translation"][k] for k in "xyz"])
        found[row["child_frame_id"]] = (r + R @ at, R @ matrix(row["rotation"]))
    return found


def bodies(robot: RobotConfig, torso: Any, angles: Any, q: Any) -> dict[str, tuple[Array, Array]]:
    """Return where MuJoCo has each frame."""
    model = mujoco.MjModel.from_xml_string(mjcf(robot))
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


def apart(found: Any, right: Any) -> float:
    return max(
        np.abs(a - b).max() for name in right for a, b in zip(found[name], right[name], strict=True)
    )


def test_the_frames_are_those_of_the_model_at_random_times(
    shown: Path, log: RunLog, robot: RobotConfig
) -> None:
    frames = payloads(shown, "xrl/xrl/scene/frames")
    dice = random.Random(3)
    for log_ns, message in dice.sample(frames, 25):
        t_ns = log_ns - log.offset_ns
        truth = next(row for row in log.messages(topics.SIM_TRUTH) if row.t_ns == t_ns)
        q = [
            angle
            for module in MODULES
            for angle in [
                row.q for row in log.messages(topics.JOINT_STATE, module) if row.t_ns <= t_ns
            ][-1]
        ]
        right = bodies(robot, truth.torso, truth.angles, q)
        found = in_world(message["transforms"])
        assert apart(found, right) < 1e-9
        assert found["com"][0].tolist() == list(truth.com)
        assert set(found) == {"world", "torso", "com", "harness", *MODULES}


@given(st.lists(st.floats(-3.0, 3.0), min_size=18, max_size=18))
def test_the_frames_are_those_of_the_model_in_any_pose(
    robot: RobotConfig, numbers: list[float]
) -> None:
    torso, angles, q = tuple(numbers[:3]), tuple(numbers[3:6]), tuple(numbers[6:])
    nothing = (0.0, 0.0, 0.0)
    pose = scene.Pose(0, torso, angles, nothing, q, (0,) * 6, nothing, nothing)
    transforms = [foxglove.transform(0, *placed) for placed in scene.frames(robot, pose)]
    assert apart(in_world(transforms), bodies(robot, torso, angles, q)) < 1e-9


def test_the_bodies_are_those_of_the_model(shown: Path, robot: RobotConfig) -> None:
    model = mujoco.MjModel.from_xml_string(mjcf(robot))
    _, message = payloads(shown, "xrl/xrl/scene/links")[0]
    found = {entity["id"]: entity for entity in message["entities"]}
    for name, kind in (("torso", "cubes"), ("sole_left", "cubes"), ("shin_right", "cylinders")):
        (shape,) = found[name][kind]
        geom = model.geom(name)
        size = [shape["size"][k] for k in "xyz"]
        at = [shape["pose"]["position"][k] for k in "xyz"]
        half = geom.size if kind == "cubes" else [geom.size[0], geom.size[0], geom.size[1]]
        assert size == pytest.approx(2 * np.array(half))
        assert at == pytest.approx(geom.pos)


def test_the_scene_comes_at_30_hz_and_shows_modes_and_forces(shown: Path, log: RunLog) -> None:
    states = payloads(shown, "xrl/xrl/scene/state")
    seconds = (states[-1][0] - states[0][0]) / 1e9
    assert len(states) / seconds == pytest.approx(30.0, rel=0.02)
    colours = set()
    arrows = 0
    for _, message in states:
        found = {entity["id"]: entity for entity in message["entities"]}
        ball = found["module_ankle_right"]["spheres"][0]["color"]
        colours.add(tuple(ball[k] for k in "rgba"))
        for arrow in found["operator"]["arrows"]:
            arrows += 1
            assert arrow["shaft_length"] + arrow["head_length"] > 0.009
    assert {scene.MODES[1], scene.MODES[2]} <= colours
    assert arrows > 5


@given(st.tuples(*[st.floats(-10.0, 10.0)] * 3).filter(lambda v: math.hypot(*v) > 1e-3))
def test_an_arrow_points_along_its_force(force: tuple[float, float, float]) -> None:
    R = matrix(dict(zip("xyzw", scene.along(force), strict=True)))
    assert np.abs(R[:, 0] - np.array(force) / math.hypot(*force)).max() < 1e-7


def test_a_log_without_a_world_has_its_robot_stand_on_its_feet(
    log: RunLog, robot: RobotConfig, tmp_path: Path
) -> None:
    real = runs.rewritten(log, tmp_path, keep=lambda name: not name.startswith("sim/"))
    out = tmp_path / "real.scene.mcap"
    export_scene(real, robot, out)
    frames = payloads(out, "xrl/xrl/scene/frames")
    ankles = dict(zip(SIDES, ankle_positions(robot), strict=True))
    for _, message in frames[:: len(frames) // 20]:
        found = in_world(message["transforms"])
        for side in SIDES:
            assert np.abs(found[f"ankle_{side}"][0] - ankles[side]).max() < 0.01
            assert found[f"ankle_{side}"][1][2, 2] > 0.99


def test_every_payload_of_every_channel_fits_its_schema(shown: Path) -> None:
    """PlotJuggler and Foxglove read a channel by its schema alone."""
    checked: Counter[str] = Counter()
    with shown.open("rb") as file:
        for described, channel, message in make_reader(file).iter_messages():
            assert described is not None
            assert (described.encoding, channel.message_encoding) == ("jsonschema", "json")
            node = json.loads(described.data)
            if described.name.startswith("foxglove."):
                node = foxglove.SCHEMAS[described.name]
            assert fits(json.loads(message.data), node), channel.topic
            checked[described.name] += 1
    assert set(checked) >= {"xrl.JointState", foxglove.TRANSFORMS, foxglove.SCENE}


def test_the_exported_log_opens_as_before(shown: Path, log: RunLog) -> None:
    again = read_run(shown)
    assert again.complete
    for key in log.keys():  # noqa: SIM118 - not a dict
        assert again.raw(key) == log.raw(key)


def parts(message: Any, node: dict[str, Any], types: Any) -> Any:
    """Build a message of Foxglove's own library from our JSON."""
    if node["type"] == "array":
        return [parts(entry, node["items"], types) for entry in message]
    if node["type"] != "object":
        return message
    title = node["title"]
    values = {name: parts(message[name], node["properties"][name], types) for name in message}
    if title in ("time", "duration"):
        return getattr(types, {"time": "Timestamp"}.get(title, "Duration"))(**values)
    if title == "foxglove.LinePrimitive":
        values["type"] = types.LinePrimitiveLineType.LineStrip
    return getattr(types, title.removeprefix("foxglove."))(**values)


def test_foxgloves_own_library_takes_the_scene_and_every_schema(
    shown: Path, tmp_path: Path
) -> None:
    sdk = pytest.importorskip("foxglove")
    types = sdk.messages
    for topic, name in (
        ("frames", foxglove.TRANSFORMS), ("links", foxglove.SCENE), ("state", foxglove.SCENE),
    ):  # fmt: skip
        for _, message in payloads(shown, f"xrl/xrl/scene/{topic}")[:20]:
            built = parts(message, foxglove.SCHEMAS[name], types)
            assert type(built).__name__ == name.removeprefix("foxglove.")
            assert built.encode()
    context = sdk.Context()
    path = tmp_path / "theirs.mcap"
    with sdk.open_mcap(path, context=context):
        for topic in topics.TOPICS:
            text = json.loads(schema.encoded(topic.type))
            channel = sdk.Channel(topic.name, schema=text, context=context)
            channel.log(json.loads(codec.encode(sample(topic.type))))
    with path.open("rb") as file:
        assert make_reader(file).get_summary() is not None


def paths_in(layout: Any) -> list[str]:
    if isinstance(layout, dict):
        own = [layout[k] for k in ("value", "topicPath") if isinstance(layout.get(k), str)]
        return own + [path for value in layout.values() for path in paths_in(value)]
    if isinstance(layout, list):
        return [path for value in layout for path in paths_in(value)]
    return []


def test_every_path_of_the_layout_is_a_number_of_a_message() -> None:
    layout = json.loads(LAYOUT.read_text(encoding="utf-8"))
    known = topics.all_keys("xrl")
    paths = paths_in(layout)
    assert len(paths) > 40
    for path in paths:
        key, _, field = path.partition(".")
        properties = schema.json_schema(known[key].type)["properties"]
        if not field:
            continue
        match = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", field)
        assert match is not None, path
        node = properties[match[1]]
        if match[2] is not None:
            assert int(match[2]) < node["maxItems"], path
            node = node["items"]
        assert node["type"] in ("number", "integer"), path


def test_the_layout_places_every_panel_once() -> None:
    layout = json.loads(LAYOUT.read_text(encoding="utf-8"))

    def leaves(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        assert node["direction"] in ("row", "column")
        assert 0 < node["splitPercentage"] < 100
        return leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
    kinds = {name.partition("!")[0] for name in layout["configById"]}
    assert kinds == {"3D", "StateTransitions", "Plot", "RawMessages"}
    shown = set(layout["configById"]["3D!scene"]["topics"])
    assert shown <= {channel.topic for channel in scene.channels("xrl")}


def test_a_layout_is_written_for_the_robot_of_the_log(made: Made, tmp_path: Path) -> None:
    out = tmp_path / "layout.json"
    assert cli.main(["export", str(made.path), "--layout", str(out)]) == 0
    assert json.loads(out.read_text(encoding="utf-8")) == layout_for("xrl")
    assert all(path.startswith("xrl/lab/") for path in paths_in(layout_for("lab")))


def test_what_cannot_be_exported_is_one_line(
    made: Made, shown: Path, log: RunLog, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    half = runs.rewritten(log, tmp_path / "half", keep=lambda name: "hip_left" not in name).path
    bare = runs.rewritten(log, tmp_path / "bare", attachments={}).path
    out = str(tmp_path / "x.mcap")
    for arguments, words in (
        ([made.path], "say what to write"),
        ([made.path, "--scene", "-o", made.path, "--force"], "is the record itself"),
        ([made.path, "--scene", "-o", shown], "exists already"),
        ([shown, "--scene", "-o", out], "already; export the original"),
        ([half, "--scene", "-o", out], "no states of hip_left"),
        ([bare, "--scene", "-o", out], "holds no robot.toml"),
    ):
        assert cli.main(["export", *map(str, arguments)]) == 2
        said = capsys.readouterr().err
        assert words in said
        assert said.count("\n") == 1
    assert not Path(out).exists()
