"""Rate, spacing, age, size and losses of a key."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.bus.codec import encode
from shared.bus.messages import Estop
from shared.clock import NS_PER_MS
from shared.exceptions import RunError
from tools.fleet.traffic import _KeyTraffic
from tools.topic_keys import TopicKey, every_key, keys_named
from tools.verbs.topic.echo import as_text

STATE = TopicKey(topics.WRENCH, "")


def message(seq: int, t_ms: float) -> bytes:
    return encode(Estop(t_ns=round(t_ms * NS_PER_MS), seq=seq, source="x"))


@given(
    periods=st.lists(st.floats(0.1, 100.0), min_size=1, max_size=40), age_ms=st.floats(0.0, 50.0)
)
def test_median_and_longest_of_spacing_and_age(periods: list[float], age_ms: float) -> None:
    traffic, now = _KeyTraffic(STATE), 1e6
    traffic.feed(message(0, now - age_ms), round(now * NS_PER_MS))
    for seq, period in enumerate(periods, 1):
        now += period
        traffic.feed(message(seq, now - age_ms), round(now * NS_PER_MS))
    assert traffic.gaps_ms is not None
    assert traffic.ages_ms is not None
    assert traffic.gaps_ms[1] == pytest.approx(max(periods), abs=1e-5)
    assert min(periods) - 1e-5 <= traffic.gaps_ms[0] <= max(periods) + 1e-5
    assert traffic.ages_ms == pytest.approx((age_ms, age_ms), abs=1e-5)
    assert traffic.count == len(periods) + 1
    assert traffic.lost == 0


def test_a_sender_on_another_host_has_no_age() -> None:
    """However near its clock is: hosts on one switch start within seconds of each other."""
    traffic = _KeyTraffic(STATE, here=False)
    for seq in range(3):
        traffic.feed(message(seq, 1e7 - 12.3 + seq), round((1e7 + seq) * NS_PER_MS))
    assert traffic.ages_ms is None
    assert traffic.gaps_ms == (1.0, 1.0)


def test_losses_are_those_of_the_window_and_rubbish_is_counted_by_its_size() -> None:
    traffic = _KeyTraffic(STATE)
    traffic.feed(message(1, 0.0), 0)
    traffic.feed(message(4, 0.0), 0)
    assert traffic.lost == 2
    traffic.begin()
    assert (traffic.lost, traffic.count, traffic.gaps_ms) == (0, 0, None)
    traffic.feed(b"\xff{no json", 0)
    traffic.feed(message(5, 0.0), 0)
    assert (traffic.lost, traffic.count) == (0, 2)
    assert traffic.size == len(b"\xff{no json") + len(message(5, 0.0))


def test_keys_are_named_by_patterns_and_a_wrong_one_says_what_there_is() -> None:
    assert keys_named(()) == every_key()
    assert [key.name for key in keys_named(["joint/hip_*/event", "estop"])] == [
        "joint/hip_right/event", "joint/hip_left/event", "estop",
    ]  # fmt: skip
    assert keys_named(["joint/**ate"]) == keys_named(["joint/*/state"])
    for wrong in ("joint/foot/state", "joint/*", "*state"):
        with pytest.raises(RunError, match="no topic is so named; there are joint") as caught:
            keys_named([wrong])
        assert str(caught.value).startswith(f"{wrong}: ")


def test_a_message_of_another_type_is_told_and_not_a_traceback() -> None:
    text = as_text(STATE, message(1, 0.0), [], as_json=False)
    assert text.endswith("bytes that are no Wrench")
