"""The plant: how the simulated robot differs from its controllers' model.

Controllers read the robot file. The world is built from the robot file *and* a plant: flexible
joints with backlash, friction, cogging, delayed torque, encoder noise, wrong zeros, wrong masses, a
sloped floor, displaced feet and a person with a mass. Only the simulator reads the plant
(`tests/test_architecture.py`).

`PlantConfig()` is the default, realistic; `IDEAL` is rigid, with friction and damping. A TOML file
or `--plant KEY=VALUE` (`plant_from`) changes single values. SI units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import tomli_w

from services.simulator.drives.axis_heat import Heat
from shared.exceptions import ConfigError
from shared.joints import N_JOINTS
from shared.toml_file import Range, Section, parse_toml, read_toml

Angle = Annotated[float, Range(-0.5, 0.5, "rad")]
Shift = Annotated[float, Range(-0.3, 0.3, "m")]
Scale = Annotated[float, Range(0.1, 3.0, "1")]

RIGID: Final = math.inf
"""`drivetrain.stiffness` of joints without flexibility."""


class Drivetrain(Section, frozen=True):
    """Drivetrain from motor to joint, the same on all 12 axes; the encoder is at the motor."""

    stiffness: Annotated[float, Range(500.0, math.inf, "N m/rad")] = 8000.0
    """Stiffness of gear and chain, seen at the joint; inf is rigid. Catalogues list harmonic drives
    of this torque class with 10 000 to 30 000 N m/rad; with a chain stage, a half to a fifth of
    that remains."""
    damping_s: Annotated[float, Range(0.0, 0.02, "s")] = 0.002
    """Damping divided by stiffness. Steel in grease has a loss factor of 1 to 5 %. At the
    drivetrain's 37 Hz (8000 N m/rad on the rotor), 0.002 s is a damping ratio of 0.23 for the rotor
    alone, including chain and bearings."""
    play: Annotated[float, Range(0.0, 0.1, "rad")] = math.radians(0.1)
    """Backlash, from stop to stop: 0.2 mm of a tensioned chain on a sprocket of 0.1 m."""
    rotor_inertia: Annotated[float, Range(0.01, 5.0, "kg m^2")] = 0.15
    """Inertia of the rotor, reflected to the joint, like `joint.armature`."""
    motor_friction: Annotated[float, Range(0.0, 20.0, "N m")] = 0.2
    """Dry friction of the rotor, reflected to the joint."""
    joint_friction: Annotated[float, Range(0.0, 20.0, "N m")] = 0.1
    """Dry friction on the joint's side: bearings and cables."""
    motor_damping: Annotated[float, Range(0.0, 50.0, "N m s/rad")] = 0.3
    joint_damping: Annotated[float, Range(0.0, 50.0, "N m s/rad")] = 0.2
    cogging: Annotated[float, Range(0.0, 5.0, "N m")] = 0.2
    """Amplitude per motor, at the joint: 0.01 N m of an outrunner, times a gear ratio of 17.5."""
    cogging_periods: Annotated[int, Range(1, 1000, "1")] = 42
    """Periods per motor turn: least common multiple of slots and poles of a small outrunner."""


class DriveErrors(Section, frozen=True):
    """Differences between a drive's commanded and actual torque."""

    lag_s: Annotated[float, Range(0.0, 0.02, "s")] = 0.001
    """First-order lag: the current loop's bandwidth of 1000 rad/s (ODrive's default)."""
    delay_s: Annotated[float, Range(0.0, 0.02, "s")] = 0.0
    """Additional pure delay; the bus adds the delay of the frames."""
    torque_scale: Scale = 1.0
    """Actual torque divided by commanded torque, as with a wrong torque constant."""


class EncoderErrors(Section, frozen=True):
    """Errors of the encoders."""

    noise_counts: Annotated[float, Range(0.0, 100.0, "counts")] = 0.5
    """Standard deviation; an encoder of 16384 counts varies by one count at rest."""
    zero_errors: tuple[Angle, ...] = (0.0,) * N_JOINTS
    """Reported minus true angle of each of the 12 joints, rad."""


class ImuErrors(Section, frozen=True):
    """Errors of the IMU, if one is fitted."""

    tilt: tuple[Angle, Angle] = (0.005, -0.005)
    """Reported minus true roll and pitch, rad: error of the sensor (0.2 to 0.5 degrees for an MTi
    630) and of its mounting.
    """
    noise: Annotated[float, Range(0.0, 0.1, "rad")] = 0.001
    """Standard deviation about each axis."""


class BodyErrors(Section, frozen=True):
    """Errors of the masses and their positions in the robot file."""

    payload_scale: Annotated[float, Range(0.0, 3.0, "1")] = 1.0
    mass_scale: Scale = 1.0
    """Factor on every body's mass."""
    com_offset: tuple[Shift, Shift, Shift] = (0.0, 0.0, 0.0)
    """Offset of the torso's centre of mass, m, torso axes."""


class Floor(Section, frozen=True):
    """The floor. The world's z axis is the floor's normal, so a slope tilts gravity."""

    slope: tuple[Angle, Angle] = (0.0, 0.0)
    """Rise along x and along y, rad: (0.05, 0) is uphill ahead."""
    step: Annotated[float, Range(-0.1, 0.1, "m")] = 0.0
    """Height of the floor under the right foot above the floor under the left foot."""
    friction: Annotated[float, Range(0.05, 2.0, "1")] = 0.8
    """Rubber on a dry floor; the robot file assumes 0.9."""
    contact_time: Annotated[float, Range(0.004, 0.1, "s")] = 0.02
    """Time constant of the contact (MuJoCo's solref): larger is softer."""


class Feet(Section, frozen=True):
    """Offsets of the feet from their positions in the robot file.

    Only their difference matters, because the world's origin is midway between the ankles.
    """

    offset_right: tuple[Shift, Shift, Angle] = (0.0, 0.0, 0.0)
    """x, y in m, yaw in rad."""
    offset_left: tuple[Shift, Shift, Angle] = (0.0, 0.0, 0.0)


class Person(Section, frozen=True):
    """The person behind the hand: a mass on legs that follows the scenario's path."""

    mass: Annotated[float, Range(0.0, 200.0, "kg")] = 80.0
    """With 0 the hand follows the path exactly, at any force."""
    leg_frequency_hz: Annotated[float, Range(0.5, 20.0, "Hz")] = 2.5
    """Frequency of the person's mass on its legs: a standing person bounces at 2 to 3 Hz
    (whole-body vibration)."""
    leg_damping_ratio: Annotated[float, Range(0.0, 2.0, "1")] = 0.4
    load_scale: Annotated[float, Range(0.0, 3.0, "1")] = 0.9
    """Fraction of the requested assist that the person rests on the harness."""
    load_lag_s: Annotated[float, Range(0.0, 2.0, "s")] = 0.2
    """Lag of that weight: a person does not shift weight at once."""


class PlantConfig(Section, frozen=True):
    """The whole plant."""

    drivetrain: Drivetrain = Drivetrain()
    drive: DriveErrors = DriveErrors()
    encoder: EncoderErrors = EncoderErrors()
    imu: ImuErrors = ImuErrors()
    body: BodyErrors = BodyErrors()
    floor: Floor = Floor()
    feet: Feet = Feet()
    person: Person = Person()
    heat: Heat = Heat()
    steps: Annotated[int, Range(1, 64, "1")] = 1
    """Steps of world and drivetrain per `simulation.timestep`; use more to check that 1 is enough.
    """
    seed: Annotated[int, Range(0, 1 << 31, "1")] = 0
    """Seed of the encoders' noise."""


IDEAL: Final = PlantConfig(
    drivetrain=Drivetrain(stiffness=RIGID, play=0.0, cogging=0.0),
    drive=DriveErrors(lag_s=0.0),
    encoder=EncoderErrors(noise_counts=0.0),
    imu=ImuErrors(tilt=(0.0, 0.0), noise=0.0),
    floor=Floor(friction=0.9),
    person=Person(mass=0.0, load_scale=1.0, load_lag_s=0.0),
)
"""Rigid, without errors except friction and damping; it only shows that the code follows the
equations."""

NAMED: Final[Mapping[str, PlantConfig]] = {"realistic": PlantConfig(), "ideal": IDEAL}


def load(path: Path) -> PlantConfig:
    """Read a plant file; a missing key keeps its default."""
    plant = read_toml(path, PlantConfig)
    _check(str(path), plant)
    return plant


def plant_from(words: Iterable[str]) -> PlantConfig:
    """Return the plant for the arguments of `--plant`.

    Args:
        words: names (`ideal`), files, or KEY=VALUE such as `drivetrain.play=0.01`, in order. A name
            or file replaces all earlier words; KEY=VALUE changes one value.
    """
    plant = PlantConfig()
    for word in words:
        key, equals, value = word.partition("=")
        if equals:
            plant = changed(plant, {key.strip(): value.strip()})
        elif word in NAMED:
            plant = NAMED[word]
        elif word.endswith(".toml"):
            plant = load(Path(word))
        else:
            right = f"use one of {', '.join(NAMED)}, a .toml file, or KEY=VALUE"
            raise ConfigError("--plant", "(name)", f"{word!r} is not a plant", right)
    return plant


def changed(plant: PlantConfig, values: Mapping[str, Any]) -> PlantConfig:
    """Return a plant with values set by dotted key; text is parsed as TOML."""
    table = msgspec.to_builtins(plant)
    for key, value in values.items():
        section, _, name = key.rpartition(".")
        target = table.get(section) if section else table
        if not isinstance(target, dict) or name not in target:
            sections = {name: rows for name, rows in table.items() if isinstance(rows, dict)}
            known = [f"{section}.{name}" for section, rows in sections.items() for name in rows]
            raise ConfigError("--plant", key, "unknown key", f"use one of {', '.join(known)}")
        is_text = isinstance(value, str)
        target[name] = (
            parse_toml(f"value = {value}", f"--plant {key}", _Any).value if is_text else value
        )
    new = parse_toml(tomli_w.dumps(table), "--plant", PlantConfig)
    _check("--plant", new)
    return new


def to_toml(plant: PlantConfig) -> str:
    """Return the plant as TOML that `load` reads back."""
    return tomli_w.dumps(msgspec.to_builtins(plant))


class _Any(Section, frozen=True):
    value: Any


def _check(file: str, plant: PlantConfig) -> None:
    found = len(plant.encoder.zero_errors)
    if found != N_JOINTS:
        raise ConfigError(
            file, "encoder.zero_errors", f"{found} values", f"give {N_JOINTS}, in rad"
        )
