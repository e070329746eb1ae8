"""deploy/foxglove/xrl.json: its panels, keys and paths exist in the viewers and in our logs."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shared.bus import topics
from shared.bus.messages import DriveStatus, Mode, PlannerMode, SplitSource
from shared.config.robot_config import RobotConfig
from shared.mcap_log import schema
from tests.shared.mcap_log.runs import ROBOT, item, write
from tests.tools.judge.reports.layout_types import FIELD, PANELS, TOPIC, Layout, Split, Tab
from tools import cli
from tools.judge.reports import scene
from tools.verbs.log.export import LAYOUT, layout_for

NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@pytest.fixture(scope="module")
def layout() -> Any:
    return msgspec.convert(json.loads(LAYOUT.read_text(encoding="utf-8")), Layout)


@pytest.fixture(scope="module")
def panels(layout: Any) -> dict[str, Any]:
    """Configuration of every panel by id, in the types of the viewers."""
    return {
        name: msgspec.convert(config, PANELS[name.partition("!")[0]])
        for name, config in layout.config_by_id.items()
    }


def leaves(node: Split | str) -> list[str]:
    return [node] if isinstance(node, str) else [*leaves(node.first), *leaves(node.second)]


def paths_of(panels: dict[str, Any]) -> Iterator[str]:
    for panel in panels.values():
        yield from (row.value for row in getattr(panel, "paths", ()))
        if hasattr(panel, "topic_path"):
            yield panel.topic_path


def levels_of(panel: Any) -> dict[str, float]:
    return {row.label: float(row.value) for row in panel.paths if NUMBER.fullmatch(row.value)}


def test_the_viewers_know_every_panel_and_every_key(layout: Any, panels: dict[str, Any]) -> None:
    assert len(panels) == len(layout.config_by_id) > 10


def test_every_panel_is_placed_once(layout: Any, panels: dict[str, Any]) -> None:
    placed = leaves(layout.layout)
    tabs = [panel for panel in panels.values() if isinstance(panel, Tab)]
    placed += [leaf for panel in tabs for tab in panel.tabs for leaf in leaves(tab.layout)]
    assert sorted(placed) == sorted(panels)
    assert all(0 <= panel.active_tab_idx < len(panel.tabs) for panel in tabs)
    splits = re.findall(r'"splitPercentage": ([\d.]+)', LAYOUT.read_text(encoding="utf-8"))
    assert all(10.0 < float(share) < 90.0 for share in splits)


def test_every_path_is_a_number_of_a_message(panels: dict[str, Any]) -> None:
    known = topics.all_keys("xrl")
    paths = [path for path in paths_of(panels) if not NUMBER.fullmatch(path)]
    assert len(paths) > 50
    for path in paths:
        match = re.fullmatch(rf"({TOPIC})((?:{FIELD})*)", path)
        assert match is not None, path
        node = schema.json_schema(known[match[1]].type)
        for name, index in re.findall(r"\.([^.\[]+)(?:\[(\d+)\])?", match[2]):
            node = node["properties"][name]
            if index:
                assert int(index) < node["maxItems"], path
                node = node["items"]
        assert node["type"] in ("number", "integer") or not match[2], path


def test_the_3d_panel_uses_frames_of_the_scene(panels: dict[str, Any]) -> None:
    view = panels["3D!scene"]
    assert set(view.topics) <= {channel.topic for channel in scene.channels("xrl")}
    assert view.follow_tf == "world"
    assert {layer.frame_id for layer in view.layers.values()} == {"world"}
    assert all(name == layer.instance_id for name, layer in view.layers.items())


def test_the_levels_are_those_of_the_robot_file(robot: RobotConfig, panels: dict[str, Any]) -> None:
    assert levels_of(panels["Plot!margins"]) == {"a fall": 0.0}
    most_ns = robot.joint_service.max_command_age_ms * 1e6
    assert levels_of(panels["Plot!ages"]) == {"HOLD": most_ns}
    assert panels["Plot!ages"].max_y_value > most_ns


def test_panels_of_modes_list_the_names_of_their_numbers(panels: dict[str, Any]) -> None:
    """The viewers know no names for the values of a JSON enumeration."""

    def names(enumeration: Any) -> str:
        return ", ".join(f"{member.value} {member.name.lower()}" for member in enumeration)

    modes, drives = panels["StateTransitions!modes"], panels["StateTransitions!drives"]
    assert modes.foxglove_panel_title == names(Mode)
    assert drives.foxglove_panel_title == names(DriveStatus)
    labels = [row.label for row in modes.paths]
    assert f"planner: {names(PlannerMode)}" in labels
    assert f"gains: {names(SplitSource)}" in labels
    for panel in panels.values():
        if not isinstance(panel, Tab):
            assert panel.foxglove_panel_title == panel.lichtblick_panel_title


def test_a_layout_is_written_for_the_robot_of_the_log(tmp_path: Path) -> None:
    out = tmp_path / "layout.json"
    record = write(tmp_path, [item(0)])
    assert cli.main(["log", "export", str(record), "--layout", str(out)]) == 0
    assert json.loads(out.read_text(encoding="utf-8")) == layout_for(ROBOT)
    text = json.dumps(layout_for("lab-2"))
    assert "xrl/xrl/" not in text
    assert text.count('"xrl/lab-2/') == LAYOUT.read_text(encoding="utf-8").count('"xrl/xrl/')
