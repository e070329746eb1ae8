"""Services that are dead or come back: what each tier holds without the one above."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import Mode
from shared.bus.traces import SimTruth
from shared.config.scenarios import Kill, Push
from shared.joints import MODULE_INDEX, MODULES
from tests.lockstep.runs import kill, modes_of, moment_of, push, restart, run, still, variant
from tests.robots import ROBOT
from tools.lab.studies.sweeps.figures import Ending, ending_of
from tools.sim.lockstep import FleetMoment, Lockstep

# ---- no planner: the joint services hold


def test_with_no_planner_at_all_it_stands_through_pushes() -> None:
    """Powered up, let down by the hoist, pushed twice. Its stop is in `test_estop.py`."""
    fleet = Lockstep(ROBOT, still(20.0, push=(push(0.5, 30, 0, 0), push(1.5, 0, 30, 0))))
    fleet.planner = None

    def go_on(seconds: float) -> list[SimTruth]:
        rows = []
        for _ in range(round(100 * seconds)):
            for _ in range(round(0.01 / ROBOT.simulation.timestep)):
                fleet.advance()
            rows.append(fleet.world.truth(0, 1.0, 0.0))
        assert not rows[-1].fallen
        return rows

    go_on(2.5)
    fleet.world.start()
    truth = go_on(3.5)[-1]
    assert truth.hoist == 0.0, "it must stand on its own feet"
    assert truth.torso[2] > 1.1
    assert max(truth.foot_left_tilt, truth.foot_right_tilt) < 0.02
    assert set(modes_of(fleet)) == {Mode.HOLD}


def test_which_way_a_motor_counts_is_not_seen_at_the_joint() -> None:
    mirrored = tuple(
        msgspec.structs.replace(module, motor_signs=(-1, 1 if "left" in module.name else -1))
        for module in ROBOT.module
    )
    # cogging and noise belong to a motor, whichever way it counts
    quiet = changed(PlantConfig(), {"drivetrain.cogging": 0.0, "encoder.noise_counts": 0.0})
    plain, signed = (
        run(config, still(0.5), plant=quiet, stands=False)
        for config in (ROBOT, msgspec.structs.replace(ROBOT, module=mirrored))
    )
    assert signed.stood
    # an encoder's counts are rounded down, whichever way it counts: 0.8 mm of play and friction
    np.testing.assert_allclose(signed.com_mm, plain.com_mm, atol=1.5)


def test_a_frozen_planner_goes_on_in_its_session() -> None:
    """All hold meanwhile. A dead one's successor has another: `test_sim.py`."""
    stops = (Kill(service="planner", at=0.5, signal="STOP"),)
    result = run(ROBOT, still(2.4, kill=stops, restart=restart(1.1)))
    held = {name for name, event in result.lockstep.events if event.mode_after == Mode.HOLD}
    assert held == set(MODULES)
    assert set(result.modes) == {Mode.TRACK}
    assert result.status.session == 1


# ---- no joint service: the drives' own loops hold


IN_STEP = (push(0.354, -24.5, 31.6, 0.0), push(2.074, -2.3, 39.9, 0.0))
"""With TRACK's gains left on the drives sway was hardly damped: 7 of 26 such pairs fell."""


@pytest.mark.parametrize(
    ("at", "pushes", "most_mm"),
    [(1.25, (), 80.0), (2.5, (), 80.0), (3.3, (), 80.0), (0.313, IN_STEP, 45.0)],
)
def test_all_six_dead_in_a_squat_stand_through_pushes(
    at: float, pushes: tuple[Push, ...], most_mm: float
) -> None:
    """The last pair in step with the sway, and without a planner."""
    dead = kill(at, *(("planner", *MODULES) if pushes else MODULES))
    pushes = pushes or (push(at + 0.3, 30.0, 0.0, 0.0), push(at + 1.3, 0.0, 30.0, 0.0))
    result = run(ROBOT, variant("squat", duration=max(4.5, at + 3.0), kill=dead, push=pushes))
    assert result.stood
    assert np.abs(result.com_mm[result.t > at, :2]).max() < most_mm


@pytest.fixture(scope="module")
def squatting() -> FleetMoment:
    """Return the moment 2 s into the squat."""
    return moment_of(ROBOT, variant("squat", kill=(), push=()), 2.0)


@pytest.mark.parametrize("module", ["ankle_left", "knee_right", "hip_left"])
def test_a_dead_services_successor_leads_again(module: str, squatting: FleetMoment) -> None:
    """Taken over without a step: no module's torque jumps, and all six track in the end.

    The successor carries on with what its drive carries.
    """
    dies = {"kill": kill(2.2, module), "restart": restart(4.0, module)}
    pushes = (push(2.5, 30.0, 0.0, 0.0), push(3.3, 0.0, 30.0, 0.0))
    carried: list[NDArray[np.float64]] = []

    def look(fleet: Lockstep, row: SimTruth) -> None:
        if 3.9 < row.scenario_s < 4.1:
            at = 2 * MODULE_INDEX[module]
            carried.append(fleet.bank.torque[at : at + 2].copy())

    scenario = variant("squat", duration=5.5, push=pushes, **dies)
    result = run(ROBOT, scenario, start=squatting, each=look)
    assert result.stood
    assert set(result.modes) == {Mode.TRACK}
    carries_nm = {"ankle_left": 0.5, "knee_right": 1.5, "hip_left": 0.2}  # at a motor
    assert np.abs(carried).max() > carries_nm[module]
    assert np.abs(np.diff(carried, axis=0)).max() < 0.3, "in 10 ms"
    assert max(result.steps_nm()) < 5.0
    (taken_over,) = (
        event for _, event in result.lockstep.events if event.mode_before == Mode.DISARMED
    )
    assert taken_over.tau_after == pytest.approx(taken_over.tau_before, abs=0.1)


@pytest.mark.parametrize(
    ("back", "away", "pushes"),
    [
        (("knee_left", 2.221, 2.271), ("ankle_right", 2.432), (push(3.575, 39.7, 5.0, 0.0),)),
        (("hip_right", 2.047, 2.347), ("planner", 2.027),
         (push(2.072, 0.9, 40.0, 0.0), push(3.509, -33.5, 21.9, 0.0))),
    ],
    ids=["one stays dead", "no planner"],
)  # fmt: skip
def test_a_service_that_comes_back_while_all_hold_is_no_stiffer_than_they_are(
    back: tuple[str, float, float], away: tuple[str, float], pushes: tuple[Push, ...]
) -> None:
    """With stand gains on one, and a hand that leads on, one leg gave and the other did not."""
    name, dies, returns = back
    kills = (*kill(dies, name), *kill(away[1], away[0]))
    happens = {"kill": kills, "restart": restart(returns, name), "push": pushes}
    result = run(ROBOT, variant("squat", duration=5.2, **happens))
    assert ending_of(result.rows[-1], 5.2, ROBOT) is Ending.STOOD
    assert result.tilt < 0.03
