"""One trial of the trips: something that is to trip, or is not, on a plant, with trips and without.

Pushes are not here: one that tips a sole is stood, or beyond what soles bear.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Final, NamedTuple

import msgspec

from services.simulator.physics.plant import IDEAL, PlantConfig, changed
from shared.bus.messages import STRAIGHT, Cause, Message, Mode, PlannerStatus, Trip
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.config import scenarios
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Push, Scenario
from shared.exceptions import RunError
from shared.places import SCENARIOS
from shared.robot.trip_table import JOINT_TRIPS, untripped
from tools.sim.lockstep import Lockstep, begin_standing

SMALL_ERRORS: Final[Mapping[str, Any]] = {
    "encoder.zero_errors": [math.radians(0.5) * (-1) ** i for i in range(12)],
    "body.payload_scale": 0.85,
    "body.com_offset": [0.015, 0.0, 0.0],
    "drive.lag_s": 0.002,
    "drivetrain.play": math.radians(0.25),
    "floor.slope": [math.radians(1.0), 0.0],
    "drive.torque_scale": 0.95,
}
PLANTS: Final[Mapping[str, PlantConfig]] = {
    "rigid": IDEAL,
    "k 8000": PlantConfig(),
    "k 5000": changed(PlantConfig(), {"drivetrain.stiffness": 5000.0}),
    "k 3000": changed(PlantConfig(), {"drivetrain.stiffness": 3000.0}),
    "k 2000": changed(PlantConfig(), {"drivetrain.stiffness": 2000.0}),
    "play 0.75 deg": changed(PlantConfig(), {"drivetrain.play": math.radians(0.75)}),
    "small errors": changed(PlantConfig(), SMALL_ERRORS),
}
"""Stiffness of the drivetrains in N m/rad."""

BEGINS_S: Final = 1.0
"""Scenario time at which the trouble begins, s."""
UP: Final = 1.188
"""Torso height at which a scenario begins, m."""


class Trouble(NamedTuple):
    """Something that happens to the robot."""

    about: str
    trip: Trip | Cause | None
    """Trip that it must cause; None: none."""
    scenario: Scenario
    errors: Mapping[str, Any] = {}
    """Errors of the plant that come with it."""
    let_go_s: float = math.inf
    """When the hand lets go, scenario time."""
    unfiltered: bool = False
    """With the gains of before the dynamic certificate, and joints that believe any command."""


class TripTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A trouble on a plant."""

    number: int
    trouble: str
    """A key of `TROUBLES`."""
    on: str
    """A key of `PLANTS`."""

    @property
    def words(self) -> str:
        """The trial in words."""
        return f"{self.trouble} on {self.on}"


KNOWN: Final = "|".join((*Trip.__members__, *Cause.__members__))


class TripResult(msgspec.Struct, frozen=True, kw_only=True):
    """How it came out."""

    led: bool
    """The scenario came to `BEGINS_S`; a robot that shakes at once never does."""
    tripped: Annotated[str, msgspec.Meta(pattern=rf"^(({KNOWN})( |$))*$")]
    """The trips and causes that came, in their order; empty: none."""
    tripped_after_s: float | None
    """To the first, from `BEGINS_S`, or from being led first if it was before that."""
    fell_at_s: float | None
    """Scenario time."""
    speed_max: float
    """The torso's largest speed upwards or down, m/s."""
    pitch_max: float
    """The torso's largest pitch, forwards or back, rad."""
    untripped_fell_at_s: float | None
    """The same on the robot on which nothing trips."""
    untripped_speed_max: float
    untripped_pitch_max: float


def unfiltered(robot: RobotConfig) -> RobotConfig:
    """Return the robot without the dynamic certificate; its joints accept any command.

    The coupling is unfiltered and the local damping a third. The load is not estimated, because
    shaking looks like a load.

    Raises:
        RunError: it has no gain schedule.
    """
    made = robot.gain_schedule
    if made is None:
        raise RunError("the robot has no gain schedule; run `xrl gains`")
    weak = msgspec.structs.replace(
        made,
        coupling_bandwidth_hz=200.0,
        coupling_damping=1.0,
        D_B=tuple(0.3 * each for each in made.D_B),
    )
    law = msgspec.structs.replace(robot.law, load_correction=(0.0, 0.0))
    return believing(msgspec.structs.replace(robot, gain_schedule=weak, law=law))


def _led(duration: float, *frames: Keyframe, push: tuple[Push, ...] = ()) -> Scenario:
    begin = (Keyframe(at=0.0, height=UP), Keyframe(at=BEGINS_S, height=UP))
    return Scenario(
        name="trips", about="of one trial", duration=duration, keyframe=(*begin, *frames), push=push
    )


def _at(at: float, height: float = UP, pitch: float = 0.0, assist: float = 0.0) -> Keyframe:
    return Keyframe(at=at, height=height, pitch=pitch, assist=assist, shift=STRAIGHT)


def _shipped(name: str) -> Scenario:
    return scenarios.load(SCENARIOS / f"{name}.toml")


_SHOVE: Final = Push(at=3.0, duration=0.3, force=(40.0, 0.0, 0.0))
TROUBLES: Final[Mapping[str, Trouble]] = {
    "shakes": Trouble(
        "gains of before the dynamic certificate, pushed with 40 N", Cause.SHAKING,
        _led(4.0, push=(_SHOVE,)), unfiltered=True,
    ),
    "sags": Trouble(
        "a person rests 200 N where 100 were requested, and lets go", Trip.SAGGING,
        _led(5.0, _at(1.2, assist=100.0)), {"person.load_scale": 2.0}, let_go_s=0.9,
    ),
    "sags slowly": Trouble(
        "300 N within 4 s where 100 were requested, hand off", Trip.SAGGING,
        _led(7.0, _at(5.0, assist=100.0)), {"person.load_scale": 3.0}, let_go_s=0.8,
    ),
    "drops": Trouble("led down by 0.39 m in 0.3 s", Trip.SAGGING, _led(3.0, _at(1.3, 0.8))),
    "is thrown about": Trouble(
        "led by 1.2 rad of pitch in 0.6 s", Trip.TURNING, _led(4.0, _at(1.6, 1.1, pitch=1.2))
    ),
    "is let go": Trouble(
        "30 % of its payload gone, and nobody's hand on it", None,
        _led(6.0), {"body.payload_scale": 0.7}, let_go_s=BEGINS_S,
    ),
    "is leaned on": Trouble(
        "50 N from the side for 3 s", Trip.EDGE,
        _led(7.0, push=(Push(at=2.5, duration=3.0, force=(0.0, 50.0, 0.0)),)),
    ),
    "is shoved": Trouble(
        "100 N from the side for 0.3 s on its way into the crawl", Trip.TIPPING,
        _led(
            6.0, _at(3.5, 0.79, pitch=1.2, assist=100.0),
            push=(Push(at=2.2, duration=0.3, force=(0.0, 100.0, 0.0)),),
        ),
    ),
    "squats": Trouble("as shipped: pushed, planner killed", None, _shipped("squat")),
    "crawls": Trouble("as shipped", None, _shipped("crawl")),
    "leans": Trouble("as shipped: held and leaned on sideways", None, _shipped("lean")),
    "shifts": Trouble("as shipped", None, _shipped("shift")),
}  # fmt: skip


class TripRun:
    """A run and what tripped in it."""

    def __init__(self, robot: RobotConfig, trouble: Trouble, plant: PlantConfig, seed: int) -> None:
        self.trips: dict[str, int] = {}
        """By name, and when, virtual ns."""
        self.fell_at_s: float | None = None
        self.speed_max = self.pitch_max = 0.0
        self.fleet = Lockstep(
            robot,
            trouble.scenario,
            seed=seed,
            plant=changed(plant, trouble.errors),
            record=self._record,
        )
        if not trouble.unfiltered:  # what shakes may never be led so far
            begin_standing(self.fleet)
        self._run(trouble.let_go_s)
        for _, event in self.fleet.events:
            if event.mode_before == Mode.TRACK and event.cause in JOINT_TRIPS:
                self.trips.setdefault(Cause(event.cause).name, event.t_ns)

    def _record(self, _topic: Topic, _module: str, message: Message) -> None:
        if isinstance(message, PlannerStatus) and message.trip:
            self.trips.setdefault(Trip(message.trip).name, self.fleet.now_ns)

    def _run(self, let_go_s: float) -> None:
        last: SimTruth | None = None
        for row in self.fleet.run():
            if row.scenario_s >= let_go_s:
                self.fleet.world.let_go()
            if last is not None and row.scenario_s > BEGINS_S and not row.fallen:
                rise = (row.torso[2] - last.torso[2]) / ((row.t_ns - last.t_ns) / NS_PER_S)
                self.speed_max = max(self.speed_max, abs(rise))
                self.pitch_max = max(self.pitch_max, abs(row.angles[1]))
            last = row
            if row.fallen:
                self.fell_at_s = row.scenario_s
                return

    def tripped_after_s(self) -> float | None:
        """Return when it tripped first, as `TripResult` says; None: never."""
        if not self.trips:
            return None
        first_ns = min(self.trips.values())
        began_ns = self.fleet.now_ns - round((self.fleet.world.scenario_s - BEGINS_S) * NS_PER_S)
        if first_ns < began_ns:
            tracks = [e.t_ns for _, e in self.fleet.events if e.mode_after == Mode.TRACK]
            began_ns = min(tracks, default=first_ns)
        return (first_ns - began_ns) / NS_PER_S


def run_trial(trial: TripTrial, robot: RobotConfig, seed: int) -> TripResult:
    """Run a trouble on a plant, with trips and without; `seed` is the noise's."""
    trouble, plant = TROUBLES[trial.trouble], PLANTS[trial.on]
    robot = unfiltered(robot) if trouble.unfiltered else robot
    seen = TripRun(robot, trouble, plant, seed)
    without = TripRun(untripped(robot), trouble, plant, seed)
    return TripResult(
        led=seen.fleet.world.scenario_s > BEGINS_S,
        tripped=" ".join(sorted(seen.trips, key=lambda name: seen.trips[name])),
        tripped_after_s=seen.tripped_after_s(),
        fell_at_s=seen.fell_at_s,
        speed_max=seen.speed_max,
        pitch_max=seen.pitch_max,
        untripped_fell_at_s=without.fell_at_s,
        untripped_speed_max=without.speed_max,
        untripped_pitch_max=without.pitch_max,
    )
