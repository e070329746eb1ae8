"""Names, globs, prefixes and remaps; what is refused beside a live robot."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.exceptions import FleetError, RunError
from tests.shared.test_links import TALK, TOOL
from tools.logs.playback import guard, selection
from tools.logs.playback.guard import ACTED_ON, IN_THE_LOOP, allowed, describe, those_of
from tools.logs.playback.selection import check_prefix, choose, clock_key, targets
from tools.topic_keys import short

KEYS = tuple(topics.all_keys("lab"))
STATES = topics.keys(topics.JOINT_STATE, "lab")
WRENCH = "xrl/lab/harness/wrench"


CHOICES = {
    "all without names, in their order": (KEYS, (), (), KEYS),
    "every module by a glob": (KEYS, ["joint/*/state"], (), STATES),
    "by a full key": (KEYS, ["xrl/lab/joint/*/state"], (), STATES),
    "by two stars across sections": (KEYS, ["joint/**/state"], (), STATES),
    "by two stars within one": (KEYS, ["joint/**ate"], (), STATES),
    "less what is excluded": (
        KEYS, ["joint/*/state"], ["joint/knee_*/state"],
        tuple(key for key in STATES if "/knee_" not in key),
    ),
    "all but what this log does not hold": (STATES, (), ["estop", "joint/*/event"], STATES),
}  # fmt: skip
"""Keys that there are, names wanted and unwanted, keys chosen."""


@pytest.mark.parametrize(("present", "wanted", "unwanted", "chosen"), CHOICES.values(), ids=CHOICES)
def test_what_is_chosen(
    present: Sequence[str], wanted: Sequence[str], unwanted: Sequence[str], chosen: Sequence[str]
) -> None:
    assert choose(present, wanted, unwanted) == chosen


def test_a_star_stays_within_its_section() -> None:
    with pytest.raises(RunError, match="no such topic"):
        choose(KEYS, ["*state"], ())


@pytest.mark.parametrize(
    ("name", "nearest"),
    [("joint/*/stat", "joint/*/state"), ("wrench", "harness/wrench"), ("e-stop", "estop")],
)
@pytest.mark.parametrize("flag", ["--topics", "--exclude", "--remap"])
def test_an_unknown_name_is_refused_with_the_nearest(name: str, nearest: str, flag: str) -> None:
    refuse: Callable[[], object] = {
        "--topics": lambda: choose(KEYS, [name], ()),
        "--exclude": lambda: choose(KEYS, (), [name]),
        "--remap": lambda: targets(KEYS, "replay", [f"{name}=a/b"], "lab"),
    }[flag]
    with pytest.raises(RunError, match=f"{flag} .*no such topic") as caught:
        refuse()
    assert str(caught.value).endswith(nearest)


def test_a_topic_that_this_log_does_not_hold_may_not_be_all_that_is_left() -> None:
    with pytest.raises(RunError, match=r"nothing is left.*joint/\*/state"):
        choose(STATES, ["estop"], ())


def test_the_prefix_stands_before_every_key_and_no_prefix_leaves_them() -> None:
    assert targets([WRENCH], check_prefix("replay"), (), "lab") == {WRENCH: f"replay/{WRENCH}"}
    assert targets([WRENCH], check_prefix("/a/b/"), (), "lab") == {WRENCH: f"a/b/{WRENCH}"}
    assert targets([WRENCH], check_prefix(""), (), "lab") == {WRENCH: WRENCH}
    assert (clock_key("replay"), clock_key("")) == ("replay/clock", "clock")


@pytest.mark.parametrize(
    "prefix", ["xrl", "xrl/lab", "/xrl/", "a b", "a//b", "**", "a/*", "@/x", "?"]
)
def test_a_prefix_that_is_none_or_where_live_keys_are_is_refused(prefix: str) -> None:
    with pytest.raises(RunError, match="--prefix"):
        check_prefix(prefix)


@given(st.text(alphabet="xrl/ab*@ ", max_size=8))
def test_no_prefix_makes_a_key_that_a_service_subscribes_to(prefix: str) -> None:
    try:
        checked = check_prefix(prefix)
    except RunError:
        return
    for target in targets(KEYS, checked, (), "lab").values():
        assert not checked or not target.startswith("xrl/")


def test_a_remap_gives_one_topic_another_name() -> None:
    found = targets(KEYS, "replay", ["harness/wrench=harness/was"], "lab")
    assert found[WRENCH] == "replay/xrl/lab/harness/was"
    assert sum(key != target.removeprefix("replay/") for key, target in found.items()) == 1


def test_a_star_in_a_remap_stands_for_the_same_in_both() -> None:
    found = targets(STATES, "r", ["joint/*/state=was/*/x"], "lab")
    assert found["xrl/lab/joint/knee_left/state"] == "r/xrl/lab/was/knee_left/x"


def test_two_topics_may_change_places_but_not_become_one() -> None:
    one, other = KEYS[0], KEYS[1]
    swap = [f"{short(one)}={short(other)}", f"{short(other)}={short(one)}"]
    found = targets(KEYS, "", swap, "lab")
    assert (found[one], found[other]) == (other, one)
    with pytest.raises(RunError, match="both become"):
        targets(KEYS, "", swap[:1], "lab")


@pytest.mark.parametrize(
    "remap",
    ["a", "=b", "harness/wrench=", "joint/*/state=a", "harness/wrench=a/*", "harness/wrench=a b",
     "harness/wrench=a/**", "harness/wrench=a//b", "joint/*/state=*/*"],
)  # fmt: skip
def test_a_remap_that_is_none_is_refused(remap: str) -> None:
    with pytest.raises(RunError, match=r"--remap|both become"):
        targets(KEYS, "replay", [remap], "lab")


def test_a_remap_of_what_is_not_played_is_refused() -> None:
    with pytest.raises(RunError, match="not among what is played"):
        targets(STATES, "replay", ["harness/wrench=a"], "lab")


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
