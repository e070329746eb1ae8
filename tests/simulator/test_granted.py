"""The simulated person asks the robot for no more than a planner grants."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from services.simulator.loop import granted
from shared.bus.messages import OperatorIntent, Vector4

ASSIST_MAX = 200.0
SHIFT_MAX = (0.02, 0.03, 0.1, 0.2)
ANY = st.floats(-1e300, 1e300)


@given(ANY, st.tuples(ANY, ANY, ANY, ANY))
def test_a_request_is_granted_within_the_robots_range(assist: float, shift: Vector4) -> None:
    asked = OperatorIntent(t_ns=1, seq=1, assist_n=assist, shift=shift)
    force, parts = granted(asked, ASSIST_MAX, SHIFT_MAX)
    assert 0.0 <= force <= ASSIST_MAX
    assert force == assist or not 0.0 <= assist <= ASSIST_MAX
    assert all(abs(part) <= most for part, most in zip(parts, SHIFT_MAX, strict=True))
