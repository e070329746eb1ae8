"""`xrl drive identify` and `xrl drive tune` on a live fleet: asked, led, measured, left."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.bus.session import open_session
from shared.clock import keep_pace
from shared.config import files as config_file
from shared.config.scenarios import Keyframe, Scenario
from shared.places import DEFAULT_CONFIG
from tests.system.fleets import xrl
from tools.bringup.identify.body_lead import BodyLead
from tools.bringup.identify.quasi_static import moments_of
from tools.bringup.tune.excitation import Excitation, SinePart
from tools.bringup.tune.pose_probe import LiveProbe

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(240)]

SHORT = Scenario(
    "identify", "", 8.0,
    (Keyframe(0.0, 1.188), Keyframe(4.0, 1.15, shift=(0.0, 0.02, 0.0, 0.0)), Keyframe(8.0, 1.188)),
)  # fmt: skip
HELD = Excitation(0.008, (SinePart(9.0, 2.0, 4),))
STEP = Excitation(0.008, (SinePart(9.0, 1.0, 3),))


def test_a_live_robot_is_led_for_a_fit_and_probed_and_leads_on(
    run_dir: Path, tmp_path: Path
) -> None:
    up = xrl("up", "--out", tmp_path / "run", run_dir=run_dir)
    assert up.returncode == 0, up.stderr
    try:
        keep_pace(run_dir)
        robot = config_file.load(DEFAULT_CONFIG)
        with open_session(robot, "identify", run_dir) as session:
            body = BodyLead(robot, session, simulated=True)
            heard = body.go(SHORT, lambda *_: None, lambda: False)
            assert heard.ended == ""
            moments = moments_of(heard.states, heard.wrenches)
            assert len(moments.t_s) > 20
            assert moments.q[:, 5].max() - moments.q[:, 5].min() > 0.05, "the hips went down"
            stopped = body.go(SHORT, lambda *_: None, lambda: True)
            assert stopped.ended == "stopped"
            applied = xrl("drive", "identify", "body", "--apply", run_dir=run_dir)
            assert applied.returncode == 2
            assert "runs with it" in applied.stderr, "and nothing was led"
        with open_session(robot, "tune", run_dir) as session:
            course = LiveProbe(session).go(0, STEP, lambda _: None, lambda: False)
            assert course.ended == ""
            assert course.r.max() == pytest.approx(0.008, rel=0.05)
            at_top = (course.t_s > 3.0) & (course.t_s < 5.0)
            assert 0.004 < course.y[at_top].mean() < 0.012
            led = LiveProbe(session).go(2, HELD, lambda _: None, lambda: False)
            assert led.ended == "", "a led row is held and given back"
            assert led.r.max() == pytest.approx(0.008, rel=0.1)
        status = xrl("status", run_dir=run_dir)
        assert "LEADING" in status.stdout
        with open_session(robot, "tune", run_dir) as session:
            probe = LiveProbe(session)
            killed: list[int] = []

            def kill(t_s: float) -> None:
                if t_s > 1.5 and not killed:
                    killed.append(xrl("kill", "planner", run_dir=run_dir).returncode)

            course = probe.go(0, STEP, kill, lambda: False)
            assert killed == [0]
            assert course.ended != "", "a planner that is gone leads nothing"
    finally:
        down = xrl("down", run_dir=run_dir)
        keep_pace(tmp_path)
    assert down.returncode == 0, down.stderr
