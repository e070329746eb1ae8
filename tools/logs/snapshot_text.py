"""A run at one moment, in words: the modules, their commands' ages, the network."""

from __future__ import annotations

from collections.abc import Sequence

from shared.bus import topics
from shared.bus.messages import JointState, Mode, name_of
from shared.clock import NS_PER_MS
from shared.joints import MODULES
from tools.logs.impairment_intervals import impairments
from tools.logs.run_log import RunLog


def states_at(log: RunLog, at_ns: int) -> list[JointState | None]:
    """Return each module's newest state at a monotonic time; None before its first."""
    return [log.newest(topics.JOINT_STATE, module).at(at_ns) for module in MODULES]


def describe_modules(states: Sequence[JointState | None]) -> str:
    """Return each module's mode, and how old the newest command was that it had."""
    found = []
    for module, state in zip(MODULES, states, strict=True):
        words = "not heard yet"
        if state is not None:
            age = "none" if state.age_ns < 0 else f"{state.age_ns / NS_PER_MS:.1f} ms"
            words = f"{name_of(Mode, state.mode)} {age}"
        found.append(f"{module} {words}")
    return ", ".join(found)


def describe_network(log: RunLog, at_ns: int, zero_ns: int) -> str:
    """Return the active impairments at a monotonic time, with times in s after a stamp.

    Empty for a run without impairments.
    """
    done = impairments(log.messages(topics.LINK_EVENT))
    now = [f"{row.title}, {row.when(zero_ns)}" for row in done if row.at(at_ns)]
    return "; ".join(now) or ("nothing is done to it here" if done else "")
