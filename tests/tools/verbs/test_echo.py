"""`xrl topic echo`: keys by the names that a person types, and messages as text."""

from __future__ import annotations

import pytest

from shared.bus import topics
from shared.bus.codec import encode
from shared.bus.messages import Estop
from shared.exceptions import RunError
from tools.topic_keys import TopicKey, every_key, keys_named
from tools.verbs.topic.echo import as_text

STATE = TopicKey(topics.WRENCH, "")


def test_keys_are_named_by_patterns_and_a_wrong_one_says_what_there_is() -> None:
    assert keys_named(()) == every_key()
    assert [key.name for key in keys_named(["joint/hip_*/event", "estop"])] == [
        "joint/hip_right/event", "joint/hip_left/event", "estop",
    ]  # fmt: skip
    assert keys_named(["joint/**ate"]) == keys_named(["joint/*/state"])
    for wrong in ("joint/foot/state", "joint/*", "*state"):
        with pytest.raises(RunError, match="no topic has this name; the topics are") as caught:
            keys_named([wrong])
        assert str(caught.value).startswith(f"{wrong}: ")


def test_a_message_of_another_type_is_told_and_not_a_traceback() -> None:
    text = as_text(STATE, encode(Estop(t_ns=0, seq=1, source="x")), [], as_json=False)
    assert text.endswith("bytes that are not a valid Wrench")
