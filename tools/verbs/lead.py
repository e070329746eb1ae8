"""`xrl lead`: requests assist, and leads a simulated robot, with a gamepad or the keyboard."""

from __future__ import annotations

import time
from collections.abc import Sequence
from enum import Enum
from typing import Annotated, Final

from rich.live import Live
from rich.text import Text

from shared.bus import topics
from shared.bus.credentials import require_operator
from shared.bus.messages import HandLead, OperatorIntent, Park, PlannerStatus
from shared.bus.session import Session, open_session
from shared.bus.traces import SimTruth
from shared.clock import now_ns
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError, HungUpError
from shared.process import StopFlag
from tools.flags import Arg, RunDirFlags
from tools.fleet.emergency_stop import BusStop, refuse_going, request_here
from tools.fleet.supervise import SupervisedFleet
from tools.keyboard import Keyboard
from tools.live.descent import asker, other_asker
from tools.pads.gamepad import BUTTONS, Gamepad, find_pad
from tools.pads.pilot import Deflection, Led, Pilot
from tools.terminal import Console

PERIOD_S: Final = 0.05
"""Period of the requests, s: an intent fades out unless it is repeated."""
LINKS_S: Final = 3.0
SETTLE_S: Final = 60.0
"""Timeout for releasing the sticks and pressing the dead man's button once, s."""
KEY_HELD_S: Final = 0.1
"""Maximum time, s, for which a key press counts as full deflection since the last poll."""


class Key(Enum):
    """Functions of keys, with the deflection that each commands."""

    UP = (1.0, 0.0, 0.0)
    DOWN = (-1.0, 0.0, 0.0)
    FORWARD = (0.0, 1.0, 0.0)
    BACK = (0.0, -1.0, 0.0)
    MORE = (0.0, 0.0, 1.0)
    LESS = (0.0, 0.0, -1.0)
    OPEN = (0.0, 0.0, 0.0, "o")
    STOP = (0.0, 0.0, 0.0, "x")
    QUIT = (0.0, 0.0, 0.0, "q")


KEYS: Final = {
    b"\x1b[A": Key.UP, b"\x1bOA": Key.UP, b"\x1b[B": Key.DOWN, b"\x1bOB": Key.DOWN,
    b"\x1b[C": Key.FORWARD, b"\x1bOC": Key.FORWARD, b"\x1b[D": Key.BACK, b"\x1bOD": Key.BACK,
    b"+": Key.MORE, b"=": Key.MORE, b"-": Key.LESS, b"o": Key.OPEN,
    b"x": Key.STOP, b" ": Key.STOP, b"q": Key.QUIT,
}  # fmt: skip


EXAMPLES: Final = """
xrl lead                 # hold the right shoulder button and move the sticks
xrl lead --keys          # arrows: height and pitch; +, -: assist; o: unpark; space: stop
xrl lead --pad Xbox --hold leftshoulder --stop x
"""


class LeadFlags(RunDirFlags):
    """Device that leads the robot."""

    keys: Annotated[bool, Arg(exclusive="by")] = False
    """use this terminal's keyboard, not a gamepad"""
    pad: Annotated[str | None, Arg(metavar="NAME", exclusive="by")] = None
    """part of the gamepad's name or path, such as Xbox (default: the first gamepad)"""
    hold: Annotated[str, Arg(choices=BUTTONS)] = "rightshoulder"
    """dead man's button"""
    stop: Annotated[str, Arg(choices=BUTTONS)] = "b"
    """emergency stop button"""

    def check(self) -> None:
        """Refuse the same button for both functions."""
        super().check()
        if self.hold == self.stop:
            raise FleetError(f"--hold and --stop are both {self.hold}; give two different buttons")


def run(flags: LeadFlags) -> int:
    """Lead until q, Ctrl-C, the stop, or the loss of the pad."""
    fleet = SupervisedFleet.attach(flags.run_dir)
    robot = fleet.manifest.robot()
    require_operator(robot, "lead")
    pad = None
    if not flags.keys:
        pad = Gamepad(find_pad(flags.pad), hold=flags.hold, stop=flags.stop)
    console = Console()
    with open_session(robot, "lead", fleet.run.path) as session:
        leader = _Leader(robot, session, simulated="simulator" in fleet.manifest.services)
        ended = _by_pad(pad, leader, console) if pad is not None else _by_keys(leader, console)
        if ended is not Key.STOP:
            console.print(
                f"ended: height and pitch stay, assist fades out in {robot.assist.fade_s:g} s"
            )
            if pad is not None and pad.gone:
                raise FleetError(f"{pad.name}: connection lost; plug it in, or bring it into range")
            return 0
        request_here(fleet.run.path)
        refuse_going(BusStop(robot, session, fleet.run.path).stop())
    console.print("stopped (DAMP). The robot sinks slowly; `xrl status` shows how to recover")
    return 0


class _Leader:
    """Sends the motion and assist that a person requests."""

    def __init__(self, robot: RobotConfig, session: Session, *, simulated: bool) -> None:
        """Start at a simulated robot's present height and pitch; raise if the robot is silent."""
        self._hand = session.publisher(topics.OPERATOR_HAND, HandLead) if simulated else None
        self._intents = session.publisher(topics.OPERATOR_INTENT, OperatorIntent)
        self._statuses = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        self._last: PlannerStatus | None = None
        truths = session.latest(topics.SIM_TRUTH, SimTruth)
        deadline = time.monotonic() + LINKS_S
        truth: SimTruth | None = None
        while (truth is None and simulated) or self._newest() is None:
            truth = truths.take() or truth
            if time.monotonic() > deadline:
                raise FleetError("no message from the robot; see `xrl status`")
            time.sleep(0.01)
        height, pitch = (truth.torso[2], truth.angles[1]) if truth is not None else (1.0, 0.0)
        self.pilot = Pilot(height, pitch, robot.assist.force_max)
        self._source = asker("lead")
        self._sent = 0

    def take_hold(self) -> None:
        """Resume leading; reduce the requested assist to at most the present assist."""
        status = self._newest()
        self.pilot.limit_assist(0.0 if status is None else status.assist_n)

    @property
    def other(self) -> str:
        """Name of another sender that requests assist now, or ""."""
        return other_asker(self._newest(), self._source)

    def lead(self, wanted: Deflection, dt: float) -> None:
        """Integrate over dt, s, and send; request assist only while no other sender does."""
        led = self.pilot.integrate(wanted, dt)
        now, self._sent = now_ns(), self._sent + 1
        if self._hand is not None:
            self._hand.put(
                HandLead(
                    t_ns=now, seq=self._sent, leads=True, height=led.height, pitch=led.pitch,
                    push=(0.0, 0.0, 0.0), source=self._source,
                )
            )  # fmt: skip
        if led.assist_n > 0.0:
            self._ask(led.assist_n)

    def open(self) -> None:
        """Request that a parked robot be led again."""
        self._sent += 1
        self._ask(self.pilot.led.assist_n, Park.OPEN)

    def _ask(self, assist_n: float, park: Park = Park.AUTO) -> None:
        if not self.other:
            self._intents.put(
                OperatorIntent(
                    t_ns=now_ns(), seq=self._sent, assist_n=assist_n, source=self._source,
                    park=int(park),
                )
            )  # fmt: skip

    def describe(self, held: str) -> Text:
        """Return the request and the robot's response as one line."""
        led: Led = self.pilot.led
        status = self._newest()
        hand = f"height {led.height:.3f} m, pitch {led.pitch:+.2f} rad, " if self._hand else ""
        given = f", given {status.assist_n:.0f} N" if status is not None else ""
        given += f"; {self.other} requests assist" if self.other else ""
        return Text(f"{held}: {hand}assist {led.assist_n:.0f} N{given}")

    def _newest(self) -> PlannerStatus | None:
        self._last = self._statuses.take() or self._last
        return self._last


def _by_pad(pad: Gamepad, leader: _Leader, console: Console) -> Key | None:
    """Lead with a gamepad until a stop, a signal or the loss of the pad; return STOP if stopped."""
    console.print(f"{pad.name}: hold the dead man's button and move the sticks; Ctrl-C quits")
    settling = time.monotonic() + SETTLE_S
    stop = StopFlag()
    last, held = time.monotonic(), False
    with Live(console=console, refresh_per_second=4, transient=True) as shown:
        while not stop and not pad.gone:
            pad.wait(PERIOD_S)
            if pad.stopped:
                return Key.STOP
            now = time.monotonic()
            if not pad.settled:
                to_do = pad.settle()
                if to_do and now > settling:
                    raise FleetError(f"{pad.name}: not ready within {SETTLE_S:g} s: {to_do}")
                shown.update(Text(to_do))
                last = now
                continue
            if pad.held and not held:
                leader.take_hold()
            held = pad.held
            if held:
                leader.lead(pad.deflection, min(now - last, 2 * PERIOD_S))
            last = now
            shown.update(leader.describe("held" if pad.held else "not held, nothing is sent"))
    return None


def _by_keys(leader: _Leader, console: Console) -> Key | None:
    """Lead with the keyboard until q, a stop or a signal; return STOP if stopped."""
    stop = StopFlag()
    with Keyboard(KEYS) as keyboard:
        if not keyboard.present:
            raise FleetError("no terminal to read keys from; to lead with a gamepad, remove --keys")
        console.print(
            "arrows: height and pitch; + and -: assist; o: unpark; space or x: STOP; q: quit"
        )
        last = time.monotonic()
        with Live(console=console, refresh_per_second=4, transient=True) as shown:
            while not stop and keyboard.present:
                presses = keyboard.wait(PERIOD_S)
                if Key.STOP in presses:
                    return Key.STOP
                if Key.QUIT in presses:
                    return None
                if Key.OPEN in presses:
                    leader.open()
                now = time.monotonic()
                leader.lead(_deflection_of(presses), min(now - last, KEY_HELD_S))
                last = now
                shown.update(leader.describe("led"))
        if not keyboard.present:
            raise HungUpError("the terminal has closed: height and pitch stay, assist fades out")
    return None


def _deflection_of(presses: Sequence[Key]) -> Deflection:
    """Return the combined deflection of several key presses, at most full deflection."""
    parts = [sum(float(press.value[axis]) for press in presses) for axis in range(3)]
    height, pitch, assist = (max(-1.0, min(1.0, part)) for part in parts)
    return Deflection(height, pitch, assist)
