"""A service's recorded memory, from which execution goes on."""

from __future__ import annotations

from typing import TypeVar

import msgspec

from shared.exceptions import RunError

M = TypeVar("M")


def memory_of(text: str, kind: type[M]) -> M:
    """Return a recorded memory."""
    try:
        return msgspec.json.decode(text, type=kind)
    except (msgspec.DecodeError, RecursionError) as error:
        raise RunError(
            f"a service's memory in the log is no {kind.__name__}: {error}; execute it again with "
            "the checkout that wrote it (`xrl log info` tells its commit)"
        ) from None
