"""Bit for bit: what counts as a difference, how far apart two floats are, and the likely reason."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import revision
from shared.bus.messages import JointEvent
from shared.bus.traces import PlannerCheckpoint
from shared.mcap_log import provenance
from tests.messages import sample
from tools.logs.reexecution.compare import Comparison, Origin, likely_reason, ulp

finite = st.floats(allow_nan=False, allow_infinity=False)


def event(tau: float = 1.5, **changes: object) -> JointEvent:
    found: JointEvent = sample(JointEvent, t_ns=7, tau_after=(tau, -2.0), **changes)
    return found


@given(value=finite)
def test_neighbouring_floats_are_one_ulp_apart_and_a_float_none_from_itself(value: float) -> None:
    assert ulp(value, value) == 0
    above = math.nextafter(value, math.inf)
    if math.isfinite(above):
        assert ulp(value, above) == ulp(above, value) == 1


def test_ulps_are_counted_through_zero() -> None:
    assert ulp(-5e-324, 5e-324) == 2
    assert ulp(1, 2.0) is None


def test_equal_messages_agree() -> None:
    comparison = Comparison()
    assert comparison.take("k", 1, event(), event())
    assert (comparison.compared, comparison.differing, comparison.first) == (1, 0, None)


@given(value=finite)
def test_the_last_bit_of_a_number_is_a_difference_that_names_its_field(value: float) -> None:
    other = math.nextafter(value, math.inf)
    if not math.isfinite(other):
        return
    comparison = Comparison()
    assert not comparison.take("joint/hip_left/event", 9, event(value), event(other))
    first = comparison.first
    assert first is not None
    assert (first.field, first.tick, first.t_ns, first.ulp) == ("tau_after[0]", 9, 7, 1)
    assert (first.recorded, first.recomputed) == (value, other)


def test_minus_zero_is_not_zero() -> None:
    comparison = Comparison()
    assert not comparison.take("k", 1, event(0.0), event(-0.0))


@pytest.mark.parametrize(("apart", "agrees"), [(0.9e-6, True), (1.1e-6, False)])
def test_a_tolerance_is_for_numbers(apart: float, agrees: bool) -> None:
    comparison = Comparison(1e-6)
    assert comparison.take("k", 1, event(1.0), event(1.0 + apart)) is agrees
    assert not comparison.take("k", 1, event(), event(cause=3))


@pytest.mark.parametrize(
    ("one", "other", "agrees"),
    [
        (0.12345, 0.12346, True),
        (0.12345, 0.12347, False),
        (20.0, 20.001, True),
        (20.0, 20.002, False),
        (1.0, 0.9, False),
        (0.123456789, 0.12345678, False),
        (1e-05, 0.0, True),
        (math.nan, 1.0, False),
    ],
)
def test_with_a_tolerance_one_unit_of_the_last_decimal_may_differ(
    one: float, other: float, agrees: bool
) -> None:
    assert Comparison(1e-12).take("k", 1, event(one), event(other)) is agrees
    assert not Comparison().take("k", 1, event(one), event(other))


def test_first_and_largest_are_kept() -> None:
    comparison = Comparison()
    for tick, change in enumerate((1e-3, 5.0, 2.0)):
        comparison.take("k", tick, event(1.0), event(1.0 + change))
    assert comparison.first is not None
    assert comparison.first.tick == 0
    assert comparison.largest["k", "tau_after[0]"].tick == 1
    assert comparison.differing == 3


def test_a_memory_is_compared_value_by_value() -> None:
    def snapshot(x: float) -> PlannerCheckpoint:
        text = msgspec.json.encode({"law": {"q": [1.0, x]}}).decode()
        return PlannerCheckpoint(t_ns=1, seq=1, session=3, snapshot=text)

    comparison = Comparison()
    comparison.take("planner/checkpoint", 4, snapshot(2.0), snapshot(3.0))
    assert comparison.first is not None
    assert comparison.first.field == "snapshot.law.q[1]"


def test_a_long_value_is_cut_in_words() -> None:
    comparison = Comparison()
    one, other = (
        PlannerCheckpoint(t_ns=1, seq=1, session=3, snapshot=text) for text in ("", "x" * 999)
    )
    comparison.take("k", 1, one, other)
    assert comparison.first is not None
    assert len(comparison.first.describe()) < 200


RUN = {
    "git_commit": "1" * 40, "git_dirty": "false", "architecture": "x86_64", "cpu_model": "EPYC",
    "libc": "glibc 2.36", "python": "3.11.2", "platform": "Linux-6.1", "cpu_count": "2",
    "thread_env": '{"OPENBLAS_NUM_THREADS":"1"}',
}  # fmt: skip
PACKAGES = {"casadi": "3.8", "msgspec": "0.22", "numpy": "2.4", "pin": "4.1"}


def origin(**changes: str) -> Origin:
    run = RUN | {key: value for key, value in changes.items() if key in RUN}
    return {"run": run, "packages": PACKAGES | {k: changes[k] for k in PACKAGES if k in changes}}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"git_commit": "2" * 40}, "code 222222222222, here 111111111111"),
        ({"git_dirty": "true"}, "code 111111111111 with changes, here 111111111111"),
        ({"architecture": "aarch64"}, "architecture aarch64, here x86_64"),
        ({"cpu_model": "0x41 part 0xd0b"}, "CPU 0x41 part 0xd0b, here EPYC"),
        ({"libc": "glibc 2.41"}, "libc glibc 2.41, here glibc 2.36"),
        ({"python": "3.13.0"}, "Python 3.13.0, here 3.11.2"),
        *(({name: "9"}, f"{name} 9, here {PACKAGES[name]}") for name in PACKAGES),
        ({"thread_env": "{}"}, "OPENBLAS_NUM_THREADS unset, here 1"),
        (
            {"thread_env": '{"OPENBLAS_NUM_THREADS":"1","OPENBLAS_CORETYPE":"Zen"}'},
            "OPENBLAS_CORETYPE Zen, here unset",
        ),
    ],
)
def test_what_differs_is_told(changes: dict[str, str], told: str) -> None:
    found = likely_reason(origin(**changes), origin())
    assert found.startswith(f"likely reason: recorded with {told}")
    assert ("--tolerance" in found) != told.startswith("code "), "a machine, but no code"


def test_all_that_differs_is_told_in_one_line() -> None:
    found = likely_reason(origin(architecture="aarch64", numpy="2.3"), origin())
    assert found == (
        "likely reason: recorded with architecture aarch64, here x86_64; numpy 2.3, here 2.4; "
        "`--tolerance 1e-9` accepts what another machine rounds differently"
    )


def test_kernel_and_number_of_processors_are_no_reason() -> None:
    found = likely_reason(origin(platform="Linux-6.18", cpu_count="64"), origin())
    assert found == "no reason known: the same environment"


def test_what_a_log_does_not_tell_is_not_taken_for_equal() -> None:
    found = likely_reason(origin(git_commit="unknown", libc="", thread_env="[]"), origin())
    assert found.startswith("no reason known: no known fact differs (unknown: ")
    assert found.endswith("(unknown: code, libc, OPENBLAS_NUM_THREADS, OPENBLAS_CORETYPE)")
    assert "unknown: code, architecture, CPU" in likely_reason({}, origin())


def test_two_checkouts_with_changes_are_not_taken_for_equal() -> None:
    changed = origin(git_dirty="true")
    assert "unknown: code" in likely_reason(changed, changed)


def test_every_fact_is_in_what_a_log_is_given() -> None:
    here = {"run": provenance.machine(), "packages": provenance.packages()}
    told = likely_reason(here, origin())
    assert "unknown: code)" in told, "the commit is of git, which may not be there"
    assert set(revision.code()) <= set(RUN)
