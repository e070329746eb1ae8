"""Random cases of the kill study, as data: each is made from the seed and its number alone."""

from __future__ import annotations

import random
from typing import Final

import msgspec

from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Push, Scenario
from shared.robot.robot_model import stand_pose
from tools.lab.studies.sweeps.push_range import SHARE, PushRange

PAYLOADS: Final = 5
"""kg, evenly spaced from none to `mass.payload_max`: each needs a gain schedule of its own."""
HEIGHT: Final = (0.79, 1.2)
"""m, torso above the ankles: from the crawl to standing."""
HEIGHT_UPRIGHT: Final = (0.85, 1.2)
"""m: the person squats, the torso stays upright."""
PITCH_MAX: Final = 1.2
"""rad: the crawl's."""
LIMIT_MARGIN: Final = 0.05
"""rad that a posture keeps from the joint limits."""
PACE: Final = (0.8, 1.6)
"""Times `SPEED`."""
SPEED: Final = (0.1, 0.24, 40.0)
"""m/s, rad/s, N/s: mean speeds of the squat (height) and of the crawl (pitch, assist)."""
LEG_MIN_S: Final = 1.0
START_S: Final = 0.5
"""Standing still before the first leg."""
STILL_S: Final = (0.3, 1.0)
"""Standing still before the kill, in the cases that are not moving."""
LET_GO_S: Final = 1.0
"""At most so long before the kill."""
PUSH_SHARE: Final = (0.1, 1.0)
"""Shares of the hardest push that is drawn (`PushRange`)."""
PUSH_S: Final = 0.3
PUSHES_MAX: Final = 3
POSES_MAX: Final = 2
AFTER_KILL_S: Final = 3.0
AFTER_PUSH_S: Final = 1.7
AFTER_LEAD_S: Final = 2.0
"""How long a case goes on after the kill, the last push and, hand on, the end of the way: an
operator who leads on against a robot that holds tips it slowly."""
DELAY_MAX_MS: Final = 20.0
DIGITS: Final = 3
"""Rounding of drawn values: a table then holds exactly the values that were run."""


class LeadPose(msgspec.Struct, frozen=True):
    """Where the operator leads."""

    height_m: float
    pitch_rad: float
    assist_n: float


class KillCase(msgspec.Struct, frozen=True, kw_only=True):
    """A drawn case. SI units; times are the scenario's."""

    number: int
    seed: int
    payload_kg: float
    poses: tuple[LeadPose, ...]
    """One or two, led to one after the other from standing."""
    pace: float
    moving: bool
    """True: killed on the way to the last pose; False: after it has been reached."""
    way_end_s: float
    """When the operator is at the last pose, if he holds on."""
    kill_s: float
    let_go_s: float | None
    """When the operator takes the hand off; None: never. The weight he rests stays."""
    delay_ms: float
    pushes: tuple[Push, ...]

    @property
    def end_s(self) -> float:
        """When there is nothing more to wait for."""
        quiet = [push.at + push.duration + AFTER_PUSH_S for push in self.pushes]
        if self.let_go_s is None:
            quiet.append(self.way_end_s + AFTER_LEAD_S)
        return max([self.kill_s + AFTER_KILL_S, *quiet])


def payloads(robot: RobotConfig) -> tuple[float, ...]:
    """Return the payloads that are drawn from, kg."""
    highest = robot.mass.payload_max
    return tuple(round(highest * i / (PAYLOADS - 1), DIGITS) for i in range(PAYLOADS))


class KillCases:
    """The cases of a robot."""

    def __init__(self, robot: RobotConfig, push: float = SHARE) -> None:
        """Take the robot; its payload is drawn.

        Args:
            robot: that is killed.
            push: share of what soles and motors bear up to which it is pushed.
        """
        self._robot, self._push = robot, push
        self._by_payload: dict[float, tuple[RobotConfig, PushRange]] = {}

    def draw(self, seed: int, number: int) -> KillCase:
        """Return one case; no other case has to be drawn for it."""
        dice = random.Random(f"kill {seed} {number}")
        payload = dice.choice(payloads(self._robot))
        loaded, pushes = self._of(payload)
        poses = tuple(_draw_pose(dice, loaded) for _ in range(dice.choice((1, 1, POSES_MAX))))
        pace = _uniform(dice, *PACE)
        begin, end = _legs(self._robot, poses, pace)[-1]
        moving = dice.random() < 0.5
        kill = _uniform(dice, *((begin, end) if moving else (end + STILL_S[0], end + STILL_S[1])))
        hand_off = dice.random() < 0.5
        at_the_kill = dice.random() < 0.5
        let_go = None
        if hand_off:
            let_go = kill if at_the_kill else _uniform(dice, max(0.0, kill - LET_GO_S), kill)
        return KillCase(
            number=number,
            seed=seed,
            payload_kg=payload,
            poses=poses,
            pace=pace,
            moving=moving,
            way_end_s=end,
            kill_s=kill,
            let_go_s=let_go,
            delay_ms=_uniform(dice, 0.0, DELAY_MAX_MS),
            pushes=tuple(_draw_pushes(dice, kill, pushes)),
        )

    def _of(self, payload: float) -> tuple[RobotConfig, PushRange]:
        if payload not in self._by_payload:
            loaded = with_payload(self._robot, payload)
            self._by_payload[payload] = loaded, PushRange(loaded, self._push)
        return self._by_payload[payload]


def _draw_pose(dice: random.Random, robot: RobotConfig) -> LeadPose:
    """Draw a posture that the legs reach, and the weight rested on it in half of the cases."""
    while True:
        upright = dice.random() < 0.5
        height = _uniform(dice, *(HEIGHT_UPRIGHT if upright else HEIGHT))
        pitch = 0.0 if upright else _uniform(dice, 0.0, PITCH_MAX)
        if reachable(robot, height, pitch):
            break
    resting = dice.random() < 0.5
    return LeadPose(height, pitch, _uniform(dice, 0.0, robot.assist.force_max) if resting else 0.0)


def _draw_pushes(dice: random.Random, kill_s: float, drawn_from: PushRange) -> list[Push]:
    """Draw pushes around and after the kill, none over another."""
    count = dice.randint(1, PUSHES_MAX)
    around = dice.random() < 0.3
    early, late = (-0.5, 0.05) if around else (0.1, 0.8)
    at = _uniform(dice, kill_s + early, kill_s + late)
    pushes = []
    for _ in range(count):
        pushes.append(drawn_from.draw(dice, PUSH_SHARE, at, PUSH_S))
        at = _uniform(dice, at + PUSH_S + 0.2, at + PUSH_S + 0.9)
    return pushes


def _uniform(dice: random.Random, low: float, high: float) -> float:
    return round(dice.uniform(low, high), DIGITS)


def reachable(robot: RobotConfig, height: float, pitch: float) -> bool:
    """Return True if the legs hold the torso so, COM over the ankles, inside the limits.

    The torso's masses lie at its origin: its pitch moves no COM, only the hips.
    """
    pose = list(stand_pose(robot, height))
    for hip in (5, 11):
        pose[hip] += pitch
    return all(
        low + LIMIT_MARGIN <= angle <= high - LIMIT_MARGIN
        for angle, (low, high) in zip(pose, robot.joint_limits(), strict=True)
    )


def _legs(
    robot: RobotConfig, poses: tuple[LeadPose, ...], pace: float
) -> list[tuple[float, float]]:
    """Return when the way to each pose begins and ends, s."""
    legs, t = [], START_S
    before = LeadPose(robot.simulation.stand_height, 0.0, 0.0)
    for pose in poses:
        ways = zip(msgspec.structs.astuple(before), msgspec.structs.astuple(pose), strict=True)
        times = [abs(b - a) / speed for (a, b), speed in zip(ways, SPEED, strict=True)]
        legs.append((t, round(t + max(LEG_MIN_S, max(times) / pace), DIGITS)))
        before, t = pose, legs[-1][1]
    return legs


def scenario_of(robot: RobotConfig, case: KillCase) -> Scenario:
    """Return the case as a scenario; the hand that lets go is not in it."""
    frames = [Keyframe(at=START_S, height=robot.simulation.stand_height)]
    for pose, (_, end) in zip(case.poses, _legs(robot, case.poses, case.pace), strict=True):
        frames.append(
            Keyframe(at=end, height=pose.height_m, pitch=pose.pitch_rad, assist=pose.assist_n)
        )
    return Scenario(
        name=f"kill-{case.seed}-{case.number}",
        about=f"case {case.number} of `xrl study sweep kill --seed {case.seed}`",
        duration=case.end_s,
        keyframe=tuple(frames),
        kill=(Kill(service="planner", at=case.kill_s),),
        push=case.pushes,
    )


def network_of(case: KillCase) -> Impairment:
    """Return what every link does in a case."""
    return Impairment(delay_ms=case.delay_ms)


def with_payload(robot: RobotConfig, payload: float) -> RobotConfig:
    """Return the robot with another payload, kg; its gain schedule may then be stale."""
    mass = msgspec.structs.replace(robot.mass, payload=payload)
    return msgspec.structs.replace(robot, mass=mass)


def row_of(case: KillCase) -> dict[str, object]:
    """Return every draw by its column; None where there was no such draw."""
    row: dict[str, object] = {
        "number": case.number,
        "seed": case.seed,
        "payload_kg": case.payload_kg,
        "pace": case.pace,
        "moving": int(case.moving),
        "way_end_s": case.way_end_s,
        "kill_s": case.kill_s,
        "let_go_s": case.let_go_s,
        "delay_ms": case.delay_ms,
    }
    for index in range(POSES_MAX):
        pose = case.poses[index] if index < len(case.poses) else None
        for key in LeadPose.__struct_fields__:
            row[f"pose{index + 1}_{key}"] = getattr(pose, key, None)
    for index in range(PUSHES_MAX):
        push = case.pushes[index] if index < len(case.pushes) else None
        row[f"push{index + 1}_at_s"] = push.at if push else None
        row[f"push{index + 1}_x_n"] = push.force[0] if push else None
        row[f"push{index + 1}_y_n"] = push.force[1] if push else None
    return row
