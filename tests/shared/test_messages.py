"""Messages and keys: bit-exact or refused; endpoints and their placeholders."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus.codec import Decoder, encode
from shared.bus.messages import JointCommand, Message
from shared.bus.topics import JOINT_STATE, TOPICS, WRENCH, Topic, all_keys, keys
from shared.bus.traces import Batch, CycleTrace, JointTrace
from shared.config import endpoints
from shared.config.endpoints import host_and_port, is_endpoint, stray_braces
from shared.config.robot_config import expand
from shared.exceptions import BusError, NonFiniteError, RunError
from shared.joints import MODULES
from shared.run_directory import live_dir
from tests.messages import filled

FINITE = st.floats(allow_nan=False, allow_infinity=False)
NOT_FINITE = (math.nan, math.inf, -math.inf)
INT64 = st.integers(min_value=-(2**63), max_value=2**63 - 1)
WORDS = st.text(alphabet=st.characters(categories=["L", "N", "Zs"]))


def messages_of(message_type: type[msgspec.Struct]) -> st.SearchStrategy[Any]:
    """Return a strategy for messages whose numbers are all finite."""

    def strategy(hint: Any) -> st.SearchStrategy[Any]:
        if get_origin(hint) is tuple:
            items = get_args(hint)
            if items[-1] is Ellipsis:
                return st.lists(strategy(items[0]), max_size=3).map(tuple)
            return st.tuples(*(strategy(item) for item in items))
        if issubclass(hint, msgspec.Struct):
            return messages_of(hint)
        return {float: FINITE, int: INT64, bool: st.booleans(), str: WORDS}[hint]

    hints = get_type_hints(message_type)
    fields = {name: strategy(hints[name]) for name in message_type.__struct_fields__}
    return st.builds(message_type, **fields)


def plain(message_type: type[Any]) -> Any:
    """Return a message of a type with every float, and every integer, the same."""
    return filled(message_type, {float: 1.5, int: 7, bool: True, str: "a null word"})


def with_floats(value: Any, change: Callable[[float], float]) -> Any:
    """Return a copy of a message whose floats went through a function, in their order."""
    if isinstance(value, tuple):
        return tuple(with_floats(item, change) for item in value)
    if isinstance(value, msgspec.Struct):
        fields = msgspec.structs.asdict(value)
        return type(value)(**{name: with_floats(item, change) for name, item in fields.items()})
    return change(value) if isinstance(value, float) else value


def floats_of(message: Message) -> list[float]:
    found: list[float] = []
    with_floats(message, lambda number: found.append(number) or number)  # type: ignore[func-returns-value]
    return found


def with_float(message: Message, place: int, number: float) -> Message:
    """Return a copy whose float number `place` is replaced."""
    met = itertools.count()
    return with_floats(message, lambda value: number if next(met) == place else value)


OF_NUMBERS = [topic for topic in TOPICS if topic.type is not Batch]
"""A batch holds messages that are encoded already."""
each_topic = pytest.mark.parametrize("topic", OF_NUMBERS, ids=lambda topic: topic.name)


@each_topic
def test_every_message_type_round_trips_bit_exactly(topic: Topic) -> None:
    @given(messages_of(topic.type))
    def round_trips(message: Message) -> None:
        decoded = Decoder(topic.type).decode(encode(message))
        assert decoded == message
        assert repr(decoded) == repr(message), "the sign of a zero, too"

    round_trips()


@each_topic
def test_a_number_that_is_not_finite_is_refused_wherever_it_stands(topic: Topic) -> None:
    message = plain(topic.type)
    assert encode(message)
    for place in range(len(floats_of(message))):
        for number in NOT_FINITE:
            with pytest.raises(NonFiniteError, match=f"{topic.type.__name__} 7: .*not finite"):
                encode(with_float(message, place, number))


@pytest.mark.parametrize("word", [b"null", b"NaN", b"Infinity", b"1e999", b'"1.5"'])
def test_what_is_no_finite_number_is_refused_and_counted_by_the_receiver(word: bytes) -> None:
    decoder = Decoder(JointCommand)
    good = encode(plain(JointCommand))
    assert decoder.decode(good) is not None
    assert decoder.decode(good.replace(b"1.5", word, 1)) is None
    assert decoder.decode(good) is not None
    assert decoder.refused == 1


def test_a_payload_of_another_type_or_with_an_optional_field_is_refused() -> None:
    decoder = Decoder(JointCommand)
    good = encode(plain(JointCommand))
    extra = good.replace(b'{"', b'{"extra":1,"', 1)
    other = encode(plain(JOINT_STATE.type))
    bad = (b"", b"\xff\xfe", b"{}", b"[]", good[:-1], good + b"x", extra, other)
    assert [decoder.decode(payload) for payload in bad] == [None] * len(bad)
    assert decoder.refused == len(bad)
    # The codec tells a number that is not finite by a null: no other null may exist.
    for topic in TOPICS:
        schema = msgspec.json.schema(topic.type)
        assert '"null"' not in msgspec.json.encode(schema).decode()


@given(st.binary(max_size=200))
def test_no_bytes_make_the_decoder_raise(payload: bytes) -> None:
    Decoder(JointCommand).decode(payload)


def test_a_key_names_robot_and_module_and_has_one_topic() -> None:
    assert JOINT_STATE.key("lab", "ankle_right") == "xrl/lab/joint/ankle_right/state"
    assert WRENCH.key("lab") == "xrl/lab/harness/wrench"
    assert keys(WRENCH, "lab") == ("xrl/lab/harness/wrench",)
    assert keys(JOINT_STATE, "lab") == tuple(f"xrl/lab/joint/{name}/state" for name in MODULES)
    every = [key for topic in TOPICS for key in keys(topic, "lab")]
    assert len(set(every)) == len(every) == len(all_keys("lab"))
    assert not [key for key in every if "*" in key]
    for key, topic in all_keys("lab").items():
        assert key in keys(topic, "lab")


@pytest.mark.parametrize("number", [2**63, -(2**63) - 1, 10**400], ids=["above", "below", "huge"])
@pytest.mark.parametrize("message_type", sorted({row.type for row in OF_NUMBERS}, key=str))
def test_no_field_of_any_message_takes_an_integer_beyond_64_bits(
    message_type: type[Message], number: int
) -> None:
    """Divided by a float one of 400 digits is an exception, in the middle of the control path."""
    payload, decoder = encode(plain(message_type)).decode(), Decoder(message_type)
    places = list(re.finditer(r"(?<=[:,\[])7(?=[,}\]])", payload))
    assert len(places) >= 2, "each has a stamp and a sequence number"
    for place in places:
        damaged = f"{payload[: place.start()]}{number}{payload[place.end() :]}"
        assert decoder.decode(damaged.encode()) is None, damaged[:400]


@pytest.mark.parametrize(
    ("endpoint", "found"),
    [
        ("tcp/legs:7447", ("legs", 7447)),
        ("tls/10.0.0.1:1", ("10.0.0.1", 1)),
        ("tls/[::1]:65535", ("::1", 65535)),
        ("tcp/[fe80::1%eth0]:7447", ("fe80::1%eth0", 7447)),
        ("tcp/legs:7447?prio=1#x", ("legs", 7447)),
    ],
)
def test_host_and_port_are_found(endpoint: str, found: tuple[str, int]) -> None:
    assert host_and_port(endpoint) == found


def test_a_placeholder_is_filled_in_once_whatever_it_is_filled_with() -> None:
    assert endpoints.filled("{a}/{b}/{c}", {"{a}": "{b}", "{b}": "2"}) == "{b}/2/{c}"
    run_dir = Path("/tmp/{run}")
    assert expand("unixsock-stream/{run}/x", run_dir) == f"unixsock-stream/{live_dir(run_dir)}/x"
    assert expand("tcp/10.0.0.1:7447", Path("/tmp")) == "tcp/10.0.0.1:7447"


@pytest.mark.parametrize(
    ("text", "stray"),
    [("{run}/a/{run}", ""), ("{Run}/a", "{Run}"), ("{run/a", "{run/a"), ("run}/a", "}"),
     ("{}/a", "{}"), ("{ru{run}n}", "{run}")],
)  # fmt: skip
def test_braces_that_nothing_is_filled_into_are_found_and_refused(text: str, stray: str) -> None:
    assert stray_braces(text, ["{run}"]) == stray
    if stray:
        with pytest.raises(BusError, match=r"is not a valid placeholder; only \{run\} is replaced"):
            expand(text, Path("/tmp"))


@pytest.mark.parametrize("path", ["/tmp/a?b", "/tmp/a#b", "/tmp/a #b"])
def test_a_socket_path_that_the_bus_would_take_apart_is_no_endpoint(path: str) -> None:
    assert not is_endpoint(f"unixsock-stream/{path}")
    assert is_endpoint(f"unixsock-stream/{re.sub('[?#]', '', path)} 50% ;")


def _at(cycle: CycleTrace, number: int) -> CycleTrace:
    """Return a cycle at its time; every third one has no sample."""
    now_ns = 10**15 + 2_000_123 * number
    sampled_ns = -1 if number % 3 == 2 else now_ns - 1_000 * number
    return msgspec.structs.replace(cycle, now_ns=now_ns, sampled_ns=sampled_ns)


@given(st.lists(messages_of(CycleTrace), min_size=1, max_size=10))
def test_cycles_come_back_from_their_columns_bit_by_bit(rows: list[CycleTrace]) -> None:
    cycles = [_at(row, number) for number, row in enumerate(rows)]
    trace = JointTrace.of(cycles, seq=3, snapshot="{}")
    found = Decoder(JointTrace).decode(encode(trace))
    assert found is not None
    assert found.t_ns == cycles[-1].now_ns
    assert encode(found.cycles) == encode(cycles)


@pytest.mark.parametrize("column", [{"pos": (1.0,)}, {"estop": ()}, {"now_ns": (1, 2)}])
def test_columns_of_different_lengths_are_an_error_in_words(column: dict[str, Any]) -> None:
    trace = JointTrace.of([filled(CycleTrace, {bool: True, int: 5, float: 1.0})], 7, "")
    damaged = msgspec.structs.replace(
        trace, columns=msgspec.structs.replace(trace.columns, **column)
    )
    with pytest.raises(RunError, match="trace 7, at 5 ns: its columns must have one entry"):
        _ = damaged.cycles
