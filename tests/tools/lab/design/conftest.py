"""The closed configurations that the planner's tests use."""

from __future__ import annotations

from tests.planner.conftest import closed, ik, limits  # noqa: F401 - fixtures
