"""A scripted sensor has no noise: only `test_frozen.py` looks at readings that stay the same."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from services.harness import filter as wrench_filter


@pytest.fixture(scope="module", autouse=True)
def never_frozen(request: pytest.FixtureRequest) -> Iterator[None]:
    """Accept constant readings, but where they are the subject."""
    with pytest.MonkeyPatch.context() as patch:
        if not request.path.name.startswith("test_frozen"):
            patch.setattr(wrench_filter, "FROZEN_NS", 1 << 62)
        yield
