"""State of a law as data: a mutable struct that holds everything that changes, and nothing else.

A law stores its state in `state`, and continues bit for bit from a copy.
"""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

S = TypeVar("S")


def copied(state: S) -> S:
    """Return a deep copy of structs and lists; immutable parts are shared."""
    copy: Any = state
    if isinstance(state, msgspec.Struct):
        if type(state).__struct_config__.frozen:
            return state
        fields = type(state).__struct_fields__
        copy = msgspec.structs.replace(
            state, **{name: copied(getattr(state, name)) for name in fields}
        )
    elif isinstance(state, list):
        copy = [copied(one) for one in state]
    found: S = copy
    return found
