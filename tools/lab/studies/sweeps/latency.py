"""`xrl study latency`: compares three controllers over good and bad networks, under pushes.

The fleet starts and is led over a good network. From a random time to the end, every link is
impaired in both directions. That time, the pushes and the lost messages are random. They are the
same for every delay and controller, but differ between repeats, losses and jitters, so a
controller's trials at one delay are independent.
"""

from __future__ import annotations

import argparse
import math
import random
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise, product
from statistics import median
from typing import Annotated, Any, Final, NamedTuple

import msgspec
import numpy as np
from rich.table import Table

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import JointEvent, JointState, Mode, RunEvent, RunEventKind
from shared.clock import NS_PER_S
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Keyframe, Scenario
from shared.exceptions import RunError
from shared.joints import MODULES
from tools.flags import Count, names_of, parsed
from tools.lab.studies.sweeps import plants, study
from tools.lab.studies.sweeps.figures import (
    EXIT_CODES,
    NOBODY,
    CaseRun,
    Ended,
    Observer,
    com_max_mm,
    event_steps_nm,
    operator_peak_n,
    parted,
    run_fleet,
    sole_tilt_max_rad,
    step_nm,
    wilson,
)
from tools.lab.studies.sweeps.plants import SHARE, PushRange, uniform
from tools.lab.studies.sweeps.study import Study, StudyFlags, StudyRun
from tools.lab.studies.sweeps.table import DECIMALS, Row, plain
from tools.output import Picture, new_figure
from tools.sim.centralised import CentralisedLockstep
from tools.sim.lockstep import Lockstep

SQUATS: Final = ((0.5, 0.0), (3.0, 0.24), (5.5, 0.0), (8.0, 0.24))
"""Time, s, and depth below the stand, m, as in the paper's Fig. 7, at its pace."""
DURATION_S: Final = 7.0
IMPAIRED_FROM_S: Final = (0.1, 2.5)
"""Range of times at which the impairment starts, s: in the stand or on the first way down. A robot
that then goes to HOLD stays at that height."""
PUSH_SHARE: Final = (0.2, SHARE)
PUSH_S: Final = 0.3
PUSHES: Final = 3
PUSHED_UNTIL_S: Final = 5.3
"""Time at which the last push has ended, s. The pushes come while links are impaired: one in each
third of the time from the impairment until then, at a random moment."""


class _ControlKind(NamedTuple):
    """One way to control the robot."""

    about: str
    fleet: type[Lockstep]
    split: str | None
    """`law.split`; None for that of the robot file."""
    colour: str
    marker: str


CONTROLS: Final = {
    "distributed": _ControlKind(
        "as shipped",
        Lockstep, None, "#1b7f4b", "o",
    ),
    "diagonal": _ControlKind(
        "the paper's local gains, diag(K_q)", Lockstep, "diagonal", "#c77700", "s"
    ),
    "centralised": _ControlKind(
        "all torques by the planner, without a lower tier, retuned gains or drive damping",
        CentralisedLockstep, None, "#7b3fa0", "^",
    ),
}  # fmt: skip
"""Controls by name."""


class Network(msgspec.Struct, frozen=True):
    """Impairment of every link, each way. Links use datagrams, so no message waits for another."""

    delay_ms: float
    jitter_ms: float
    """Uniform, plus or minus this."""
    loss: float
    """Fraction of the messages."""


class Draw(NamedTuple):
    """Random draws of a trial."""

    impaired_from_s: float
    shoves: tuple[tuple[float, float, float], ...]
    """Pushes: time, s; fraction of what soles and motors withstand along their direction
    (`PushRange`); angle, rad from x (forwards) to y (left)."""
    fleet_seed: int
    """Seed of losses, jitter and the harness sensor's noise."""


class LatencyTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A trial of one controller over one network."""

    number: int
    """Number of the row."""
    repeat: int
    seed: int
    control: str
    network: Network

    @property
    def draw(self) -> Draw:
        """The random draws, equal for every delay and controller."""
        jitter, loss = plain(self.network.jitter_ms), plain(self.network.loss)
        dice = random.Random(f"latency {self.seed} {self.repeat} {jitter} {loss}")
        begin = uniform(dice, *IMPAIRED_FROM_S)
        third = (PUSHED_UNTIL_S - begin) / PUSHES
        shoves = []
        for index in range(PUSHES):
            at = begin + index * third + dice.uniform(0.0, third - PUSH_S)
            shoves.append((at, dice.uniform(*PUSH_SHARE), dice.uniform(-math.pi, math.pi)))
        return Draw(begin, tuple(shoves), dice.getrandbits(48))

    def scenario(self, robot: RobotConfig) -> Scenario:
        """Return the trial as a scenario."""
        stand = robot.simulation.stand_height
        draw, pushes = self.draw, PushRange(robot)
        fields = msgspec.structs.asdict(self.network)
        bad = Inject(link="all", at=draw.impaired_from_s, **fields)
        return Scenario(
            name=f"latency-{self.seed}-{self.number}",
            about=f"trial {self.number} of `xrl study latency --seed {self.seed}`",
            duration=DURATION_S,
            keyframe=tuple(Keyframe(at=at, height=stand - depth) for at, depth in SQUATS),
            push=tuple(pushes.push(at, PUSH_S, *how) for at, *how in draw.shoves),
            inject=(bad,) if any(fields.values()) else (),
        )

    def true_plant(self) -> PlantConfig:
        """Return the simulated robot, with random errors that are equal for each controller."""
        return plants.draw(f"latency {self.draw.fleet_seed}")


class _LatencyResult(Ended, frozen=True, kw_only=True):
    """The figures of a trial over the bad network, to the end or the fall."""

    operator_peak_n: float | None = None
    """Vertical force of the hand."""
    operator_rms_n: float | None = None
    com_max_mm: float | None = None
    """Largest horizontal distance of the COM from midway between the ankles."""
    hold_share: float | None = None
    """Fraction of the time in which a module held, so the robot did not follow the hand.

    Always 0 for the centralised controller, which has no HOLD.
    """
    holds: int | None = None
    """Changes from TRACK to HOLD of the module with the most."""
    torque_step_nm: float | None = None
    """Largest change of a joint's torque from one state to the next (4 ms)."""
    hold_step_nm: float | None = None
    """Largest step of a joint's torque into or out of HOLD, from one cycle to the next."""
    sole_tilt_max_rad: float | None = None


def row_of(trial: LatencyTrial) -> dict[str, object]:
    """Return a trial by column; the network as in its flags, to the last digit."""
    network = msgspec.structs.asdict(trial.network)
    return {
        "number": trial.number,
        "repeat": trial.repeat,
        "control": trial.control,
        **{name: plain(value) for name, value in network.items()},
        "impaired_from_s": trial.draw.impaired_from_s,
    }


def robot_of(robot: RobotConfig, control: str) -> RobotConfig:
    """Return the robot with the gain split of a controller."""
    split = CONTROLS[control].split
    if split is None:
        return robot
    return msgspec.structs.replace(robot, law=msgspec.structs.replace(robot.law, split=split))


def run_trial(
    trial: LatencyTrial, robot: RobotConfig, observer: Observer = NOBODY
) -> _LatencyResult:
    """Run a trial to its end or to the fall, and measure it."""
    draw = trial.draw
    run = run_fleet(
        trial, robot_of(robot, trial.control), observer, Impairment(), seed=draw.fleet_seed,
        from_s=draw.impaired_from_s, kept=(JointState, RunEvent),
        fleet_type=CONTROLS[trial.control].fleet,
    )  # fmt: skip
    if not run.began:
        return _LatencyResult(**run.ended(DURATION_S, robot))
    started = (m for _, m in run.messages if isinstance(m, RunEvent))
    from_ns = next(m.t_ns for m in started if m.kind == RunEventKind.STARTED)
    from_ns += round(draw.impaired_from_s * NS_PER_S)
    hand = np.array([row.operator_force[2] for row in run.rows])
    since = [
        (module, event)
        for module, event in run.events
        if event.t_ns >= from_ns and event.mode_after in (Mode.HOLD, Mode.TRACK)
    ]
    into_hold = [module for module, event in since if event.mode_after == Mode.HOLD]
    return _LatencyResult(
        **run.ended(DURATION_S, robot),
        operator_peak_n=operator_peak_n(run.rows),
        operator_rms_n=float(np.sqrt(np.mean(hand * hand))),
        com_max_mm=com_max_mm(run.rows),
        hold_share=hold_share(run.events, from_ns, run.rows[-1].t_ns),
        holds=max(into_hold.count(module) for module in MODULES),
        torque_step_nm=_torque_step_nm(run, from_ns),
        hold_step_nm=max(event_steps_nm(event for _, event in since), default=0.0),
        sole_tilt_max_rad=sole_tilt_max_rad(run.rows),
    )


def _torque_step_nm(run: CaseRun, from_ns: int) -> float:
    largest = 0.0
    for module in MODULES:
        states = [m for name, m in run.messages if name == module and isinstance(m, JointState)]
        steps = (step_nm(a.tau, b.tau) for a, b in pairwise(states) if b.t_ns >= from_ns)
        largest = max(largest, max(steps, default=0.0))
    return largest


def hold_share(events: Sequence[tuple[str, JointEvent]], from_ns: int, to_ns: int) -> float:
    """Return the fraction of a period in which any module held, from the whole run's `events`."""
    if to_ns <= from_ns:
        return 0.0
    holding: set[str] = set()
    held_ns, since_ns = 0, from_ns
    for module, event in sorted(events, key=lambda row: row[1].t_ns):
        now_ns = min(max(event.t_ns, from_ns), to_ns)
        if holding:
            held_ns += now_ns - since_ns
        since_ns = now_ns
        if event.mode_after == Mode.HOLD:
            holding.add(module)
        else:
            holding.discard(module)
    if holding:
        held_ns += to_ns - since_ns
    return held_ns / (to_ns - from_ns)


DELAYS_MS: Final = "0,10,20,30,50,100,200"
LOSSES: Final = "0,0.1,0.3,0.5"
DELAY_MAX_MS: Final = 60_000.0


def values_up_to(high: float) -> Callable[[str], tuple[float, ...]]:
    """Return a parser for argparse that reads `0,10,50` as ascending numbers without repeats."""

    def read(text: str) -> tuple[float, ...]:
        try:
            found = {round(float(word), DECIMALS) for word in text.split(",")}
        except ValueError:
            found = {math.nan}
        if not all(0.0 <= value <= high for value in found):
            raise argparse.ArgumentTypeError(
                f"{text!r}: must be numbers from 0 to {high:g} separated by commas, such as 0,0.5"
            )
        return tuple(sorted(found))

    return read


_DELAYS: Final = values_up_to(DELAY_MAX_MS)
_SHARES: Final = values_up_to(1.0)

EXAMPLES: Final = """
xrl study latency
xrl study latency --delay 0,50,150 --jitter 5 --loss 0,0.2 --n 10 --out out/latency
xrl study latency --cluster tcp://HOST:8786
"""


class LatencyStudyFlags(StudyFlags):
    """Networks and controllers to compare."""

    delay: Annotated[
        tuple[float, ...],
        parsed(
            _DELAYS, "MS", is_one=True,
            help="delay of every link, each way; or several, separated by commas "
            f"(default: {DELAYS_MS})",
        ),
    ] = _DELAYS(DELAYS_MS)  # fmt: skip
    jitter: Annotated[tuple[float, ...], parsed(_DELAYS, "MS", is_one=True)] = (0.0,)
    """half the width of the uniform jitter; or several (default: 0)"""
    loss: Annotated[
        tuple[float, ...],
        parsed(
            _SHARES, "P", is_one=True,
            help="probability that a message is lost; or several "
            f"(default: {LOSSES})",
        ),
    ] = _SHARES(LOSSES)  # fmt: skip
    n: Count = 4
    """trials per network and controller"""
    control: Annotated[
        tuple[str, ...],
        parsed(
            names_of(CONTROLS), "NAME,...", is_one=True,
            help="controllers to compare (default: all): "
            + "; ".join(f"{name}: {control.about}" for name, control in CONTROLS.items()),
        ),
    ] = tuple(CONTROLS)  # fmt: skip

    def check(self) -> None:
        """Refuse an empty comparison."""
        super().check()
        if not self.control:
            raise RunError(f"--control: name at least one of {', '.join(CONTROLS)}")


def grid_of(flags: LatencyStudyFlags) -> list[tuple[Network, str]]:
    """Return each network with each controller."""
    networks = [Network(d, j, p) for p, j, d in product(flags.loss, flags.jitter, flags.delay)]
    return list(product(networks, flags.control))


def trial_of(grid: Sequence[tuple[Network, str]], seed: int, number: int) -> LatencyTrial:
    """Return the trial with a number.

    The numbers run through the whole grid, then again. So an interrupted study has trials of each
    network, and a resumed study may have more trials.
    """
    repeat, place = divmod(number, len(grid))
    network, control = grid[place]
    return LatencyTrial(number=number, repeat=repeat, seed=seed, control=control, network=network)


class _Cell(NamedTuple):
    """Trials of one controller at one delay."""

    fallen: int
    of: int
    operator_peak_n: float
    """Median."""
    hold_share: float
    """Median."""

    @property
    def words(self) -> str:
        """The cell of the table; the bounds are for the fraction of falls in this mix."""
        low, high = wilson(self.fallen, self.of)
        bounds = f"{100 * low:.0f}-{100 * high:.0f} %"
        return (
            f"{self.fallen}/{self.of} {bounds:>9} {self.operator_peak_n:4.0f} N "
            f"{100 * self.hold_share:3.0f} %"
        )


def cells_of(rows: Sequence[Row]) -> dict[tuple[str, float], _Cell]:
    """Return the trials by controller and delay, in the order of `CONTROLS`."""
    cells = {}
    delays = sorted({float(row["delay_ms"]) for row in rows})
    for control, delay in product(CONTROLS, delays):
        own = [r for r in rows if (r["control"], float(r["delay_ms"])) == (control, delay)]
        if own:
            known = [row for row in own if row["operator_peak_n"] is not None]
            peak, held = (
                median([row[column] for row in known]) if known else math.nan
                for column in ("operator_peak_n", "hold_share")
            )
            cells[control, delay] = _Cell(len(parted(own)[1]), len(own), peak, held)
    return cells


def mix(rows: Sequence[Row]) -> str:
    """Return the losses and jitters that each delay combines, as text."""
    losses = sorted({float(row["loss"]) for row in rows})
    jitters = sorted({float(row["jitter_ms"]) for row in rows})
    words = ", ".join(f"{100 * loss:g}" for loss in losses) + " % lost"
    return words if jitters == [0.0] else f"{words}, {', '.join(map('{:g}'.format, jitters))} ms"


def report(finished: StudyRun) -> None:
    """Print falls, hand and HOLD by delay, and the command for each controller's first fall."""
    rows, console = finished.rows, finished.console
    cells = cells_of(rows)
    names = list(dict.fromkeys(control for control, _ in cells))
    title = f"Falls with 95 % interval (Wilson), hand's peak, time in HOLD; mix: {mix(rows)}"
    printed = Table(title=title, title_justify="left")
    for heading in ("delay ms", *names):
        printed.add_column(heading, justify="right")
    for delay in dict.fromkeys(delay for _, delay in cells):
        some = [cells.get((name, delay)) for name in names]
        printed.add_row(f"{delay:g}", *("" if one is None else one.words for one in some))
    console.print(printed)
    for name in names:
        own = [row for row in rows if row["control"] == name]
        _, fallen = parted(own)
        console.print(f"{name}: {len(fallen)} of {len(own)} fell", highlight=False)
        for first in fallen[:1]:
            again = f"{finished.command} --only {first['number']}"
            console.print(f"  {first['ending']}: {again}", style="dim", soft_wrap=True)


def draw(finished: StudyRun) -> Picture:
    """Draw the fraction of falls and the hand's force by delay."""
    rows = finished.rows
    cells = cells_of(rows)
    figure = new_figure(8, 8)
    falls, effort = figure.subplots(2, 1, sharex=True)
    delays = sorted({delay for _, delay in cells})
    for name in dict.fromkeys(control for control, _ in cells):
        style: dict[str, Any] = {"color": CONTROLS[name].colour, "marker": CONTROLS[name].marker}
        own = [(x, cells[name, d]) for x, d in enumerate(delays) if (name, d) in cells]
        places = [x for x, _ in own]
        shares = np.array([100 * cell.fallen / cell.of for _, cell in own])
        low, high = 100 * np.transpose([wilson(cell.fallen, cell.of) for _, cell in own])
        spread = np.maximum(0.0, (shares - low, high - shares))
        falls.errorbar(places, shares, spread, capsize=3, label=name, **style)
        peaks = [cell.operator_peak_n for _, cell in own]
        effort.plot(places, peaks, **style)
    falls.set(ylabel="falls in %, 95 % (Wilson)", ylim=(-3.0, 103.0))
    falls.legend()
    effort.set(ylabel="hand's peak force in N, median", xlabel="delay each way in ms, not to scale")
    effort.set_xticks(range(len(delays)), [f"{delay:g}" for delay in delays])
    for axis in (falls, effort):
        axis.grid(visible=True, lw=0.3)
    figure.suptitle(
        f"{len(rows)} runs of {DURATION_S:g} s, seed {finished.flags.seed}: squats led by hand, "
        f"{PUSHES} pushes of up to\n{SHARE:.0%} of what soles and motors withstand; {mix(rows)}",
        fontsize=10, x=0.01, ha="left",
    )  # fmt: skip
    return figure


STUDY: Final = Study[LatencyTrial](
    name="latency",
    case="trial",
    table="latency.csv",
    total=lambda flags: flags.n * len(grid_of(flags)),
    cases=lambda flags, _robot: partial(trial_of, grid_of(flags), flags.seed),
    decided_by=("delay", "jitter", "loss", "control"),
    row=row_of,
    figures=_LatencyResult,
    trial=run_trial,
    report=report,
    draw=draw,
    exit_code=lambda row: EXIT_CODES[row["ending"]] if row["control"] == "distributed" else 0,
)


def run(flags: LatencyStudyFlags) -> int:
    """Run the study, or one trial of it."""
    return study.run(STUDY, flags)
