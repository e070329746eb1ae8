"""The standing fit on plants with every error drawn: the table of docs/identify.md."""

from __future__ import annotations

import random
from typing import Any

import msgspec
import numpy as np
import pytest

from services.simulator.physics.plant import PlantConfig
from shared.bus import topics
from shared.bus.messages import Message
from shared.bus.topics import Topic
from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tests.conftest import ROBOT_FILE
from tools.bringup.identify.body_fit import COM, HARNESS, MASS, SCALE, ZEROS, Record, fit
from tools.bringup.identify.quasi_static import Moments, TimedRows, moments_of
from tools.lab.studies.sweeps import plants
from tools.sim.lockstep import Lockstep

PLANTS = 10


def drawn(number: int) -> PlantConfig:
    """Return a plant with every error drawn, its floor level within some 2 mrad."""
    plant, dice = plants.draw(f"identify/{number}"), random.Random(f"slope{number}")
    slope = dice.gauss(0.0, 0.002), dice.gauss(0.0, 0.002)
    floor = msgspec.structs.replace(plant.floor, slope=slope, step=dice.uniform(-0.001, 0.001))
    return msgspec.structs.replace(plant, floor=floor)


def led(robot: RobotConfig, plant: PlantConfig) -> Moments:
    """Return the moments of a run of the motions in lockstep."""
    rows: dict[tuple[str, str], tuple[list[int], list[Any]]] = {}

    def record(topic: Topic, module: str, message: Message) -> None:
        if topic in (topics.JOINT_STATE, topics.WRENCH):
            t_ns, messages = rows.setdefault((topic.name, module), ([], []))
            t_ns.append(message.t_ns)
            messages.append(message)

    scenario = scenarios.load(ROBOT_FILE.parent / "scenarios" / "identify.toml")
    fleet = Lockstep(robot, scenario, record=record, plant=plant)
    assert not any(truth.fallen for truth in fleet.run())
    states = [TimedRows(*rows[topics.JOINT_STATE.name, name]) for name in MODULES]
    return moments_of(states, TimedRows(*rows[topics.WRENCH.name, ""]))


def truth_of(robot: RobotConfig, plant: PlantConfig) -> dict[str, float]:
    body = plant.body
    torso = robot.torso_mass + (body.payload_scale - 1.0) * robot.mass.payload
    torso *= body.mass_scale
    truth = {SCALE: plant.drive.torque_scale - 1.0, MASS: torso - robot.torso_mass}
    truth |= {name: torso * by for name, by in zip(COM, body.com_offset, strict=True)}
    truth |= dict.fromkeys(HARNESS, 0.0)
    return truth | dict(zip(ZEROS, plant.encoder.zero_errors, strict=True))


@pytest.mark.wide
@pytest.mark.parametrize("number", range(PLANTS))
def test_nearly_all_true_values_lie_within_their_intervals(robot: RobotConfig, number: int) -> None:
    plant = drawn(number)
    found = fit(robot, [Record(led(robot, plant))], level_sd=0.003)
    off = {
        name: (found.of(name)[0] - value) / found.of(name)[1]
        for name, value in truth_of(robot, plant).items()
    }
    outside = [name for name, by in off.items() if abs(by) > 1.96]
    assert len(outside) <= 2, outside
    assert np.max(np.abs(list(off.values()))) < 3.5
