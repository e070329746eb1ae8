"""What is refused beside a live robot."""

from __future__ import annotations

import re

import pytest

from shared.bus import topics
from shared.exceptions import FleetError
from tests.shared.test_links import TALK, TOOL
from tools.logs.playback import guard, selection
from tools.logs.playback.guard import ACTED_ON, IN_THE_LOOP, allowed, describe, those_of

KEYS = tuple(topics.all_keys("lab"))
LIVE = "the joint service knee_left is heard"


def on_live_keys(*remaps: str) -> dict[str, str]:
    return selection.targets(KEYS, "", remaps, "lab")


def under_prefix() -> dict[str, str]:
    return selection.targets(KEYS, "replay", (), "lab")


def test_what_a_live_service_acts_on_is_what_any_but_recorder_and_tools_takes() -> None:
    taken = {topic for topic, (_, takers) in TALK.items() if set(takers) - {"recorder", TOOL}}
    assert taken == set(ACTED_ON)
    assert set(IN_THE_LOOP) < set(ACTED_ON)


def test_no_key_under_a_prefix_is_one_that_a_robot_acts_on() -> None:
    assert those_of(ACTED_ON, under_prefix().values()) == []
    assert allowed(under_prefix(), LIVE, force=False) == under_prefix()


def test_without_a_live_drive_everything_goes() -> None:
    assert allowed(on_live_keys(), "", force=False) == on_live_keys()


def test_beside_a_live_drive_every_topic_that_it_acts_on_is_refused_by_name() -> None:
    for row in ACTED_ON:
        key = row.key("lab", "knee_left" if row.per_module else "")
        with pytest.raises(FleetError, match=re.escape(row.name)) as caught:
            allowed({key: key}, LIVE, force=False)
        assert LIVE in str(caught.value)
    rest = {key: key for key in KEYS if key not in those_of(ACTED_ON, KEYS)}
    assert allowed(rest, LIVE, force=False) == rest


def test_force_lets_all_go_but_what_moves_the_robot_by_itself() -> None:
    left = allowed(on_live_keys(), LIVE, force=True)
    names = set(describe(left.values()).split(", "))
    assert {"estop", "harness/tare", "sim/control", "operator/intent"} <= names
    assert not {"joint/*/command", "joint/*/state", "harness/wrench"} & names
    commands = {key: key for key in topics.keys(topics.JOINT_COMMAND, "lab")}
    with pytest.raises(FleetError, match="even with --force"):
        allowed(commands, LIVE, force=True)


def test_a_remap_onto_a_command_is_a_command_whatever_it_was() -> None:
    remap = "sim/truth=joint/knee_left/command"
    one = {"xrl/lab/sim/truth": "xrl/lab/joint/knee_left/command"}
    assert selection.targets(list(one), "", [remap], "lab") == one
    with pytest.raises(FleetError):
        allowed(one, LIVE, force=False)
    assert those_of(IN_THE_LOOP, ["xrl/another/joint/knee_left/command"])
    assert guard.those_of(ACTED_ON, ["xrl/lab/joint/knee_left/commands", "xrl/lab/a/estop"]) == []
