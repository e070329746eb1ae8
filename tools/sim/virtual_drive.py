"""A module's drive in lockstep: a model of driver and bus that acts on the emulated axes.

The bus includes the kernel's send queue (`shared.can.interface`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from services.joint.drivers.base import (
    HEAT_EVERY_NS,
    SUPPLY_EVERY_NS,
    DriveReading,
    MotorTarget,
    real_readings,
)
from services.joint.drivers.bus_watch import BusWatch
from services.simulator.drives.axis_bank import AxisBank
from shared.bus.messages import DriveStatus, Pair
from shared.can.cansimple import AxisState, ControlMode, InputMode
from shared.can.interface import QUEUED_MAX
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.sections import DriveConfig
from shared.rounding import RATE, TURNS, rounded

ASK_EVERY_NS: Final = 100 * NS_PER_MS
"""Period of heartbeats, ns; the CAN driver requests an idle axis's count at each of them."""

# Constants for comparisons in each cycle (docs/contributing.md, The control path)
_LOST, _IDLE, _ARMED = DriveStatus.LOST, DriveStatus.IDLE, DriveStatus.ARMED
_UNACKNOWLEDGED: Final = DriveStatus.UNACKNOWLEDGED
_CLOSED_LOOP: Final = AxisState.CLOSED_LOOP_CONTROL

Apply = Callable[[], None]
"""Effect of a row of frames on its drive."""


class VirtualBus:
    """Carries a row of frames at once while a node acknowledges it; otherwise the row waits.

    Attributes:
        acknowledged: True while a node acknowledges frames.
        choked: True while other nodes' frames fill the send queue, which then accepts no row.
        ages_ns: ages of the rows that waited and then reached their drive.
        thrown_away: number of rows that waited and were discarded.
    """

    def __init__(self, bank: AxisBank, axes: Sequence[int]) -> None:
        """Connect the axes (0 .. 11) of the bank that are on this bus."""
        self.acknowledged, self.choked = True, False
        self.thrown_away = 0
        self.ages_ns: list[int] = []
        self._conditions, self._axes = bank.conditions, frozenset(axes)
        self._waiting: list[tuple[int, Apply]] = []

    def advance(self, now_ns: int) -> None:
        """Update whether a node acknowledges; if so, deliver the waiting rows."""
        conditions = self._conditions
        deaf = conditions.silent | conditions.deaf
        self.acknowledged = not (deaf and deaf.issuperset(self._axes))
        self.choked = not conditions.choked.isdisjoint(self._axes)
        if self._waiting and self.acknowledged:
            waiting, self._waiting = self._waiting, []
            for sent_ns, apply in waiting:
                self.ages_ns.append(now_ns - sent_ns)
                apply()

    def put(self, now_ns: int, apply: Apply) -> None:
        """Send a row, which waits while no node acknowledges; drop it if the queue is full."""
        if self.acknowledged:
            apply()
        elif len(self._waiting) < QUEUED_MAX:
            self._waiting.append((now_ns, apply))

    @property
    def waiting(self) -> int:
        """Number of waiting rows."""
        return len(self._waiting)

    def restart(self) -> None:
        """Discard the waiting rows."""
        self.thrown_away += len(self._waiting)
        self._waiting.clear()


class VirtualDrive:
    """One ODrive of the bank, as a `Drive` in the drive's turns (`WiredDrive` converts them)."""

    def __init__(
        self,
        bank: AxisBank,
        index: int,
        drive: DriveConfig,
        clock: Callable[[], int],
        *,
        bus: VirtualBus | None = None,
        counts_per_turn: int,
        tells_heat: bool = False,
    ) -> None:
        """Connect drive `index` (0 .. 5) of the bank to its service's clock and its bus.

        Without a `bus`, the drive has a separate bus, on which a node always acknowledges. With
        `tells_heat` it reports its thermistors once a second, as firmware 0.6 does.
        """
        self._bus = bus or VirtualBus(bank, (2 * index, 2 * index + 1))
        self._watch = BusWatch(echoes=True)
        self._bank = bank
        self._axes = (2 * index, 2 * index + 1)
        self._module = slice(2 * index, 2 * index + 2)
        self._drive, self._clock, self._counts_per_turn = drive, clock, counts_per_turn
        self._lost_after_ns = round(drive.lost_after_s * NS_PER_S)
        self._sampled_ns = clock()
        self._ask_at_ns = 0
        self._heat_at_ns = clock() if tells_heat else None
        self._supply_at_ns, self._supply_v = 0, 0.0
        self._written = True
        """False for a new service, which reads the torques of a drive that it finds armed."""

    def assume_heard(self) -> None:
        """Set the time of the drive's last sample to now."""
        self._sampled_ns = self._clock()
        self._watch.received(self._sampled_ns)

    def start_service(self) -> None:
        """Connect a new service, which first reads the torques that an armed drive applies."""
        self._written = False
        self._watch = BusWatch(echoes=True)
        self._put(self._clock(), self._feed)  # its first request

    def read(self, timeout_s: float) -> DriveReading | None:  # noqa: ARG002 - it is there at once
        """Return a reading: for a silent drive None at first, then LOST or UNACKNOWLEDGED."""
        bank, (a, b), now_ns = self._bank, self._axes, self._clock()
        is_responding = bank.is_responding(a)
        self._look_after(now_ns, is_responding=is_responding)
        if is_responding:
            self._sampled_ns = now_ns
        elif now_ns - self._sampled_ns <= self._lost_after_ns:
            return None
        armed = bank.state[a] == bank.state[b] == _CLOSED_LOOP
        watch = self._watch
        if not is_responding:
            status = _UNACKNOWLEDGED if watch.unacknowledged else _LOST
        elif watch.carries_nothing(now_ns):
            status = _UNACKNOWLEDGED
        else:
            status = _ARMED if armed else _IDLE
        errors = 0 if armed else bank.heartbeat(a).errors | bank.heartbeat(b).errors
        pos, vel = bank.pos_estimate, bank.vel_estimate
        fet = motor = None
        if self._heat_at_ns is not None and is_responding and now_ns >= self._heat_at_ns:
            self._heat_at_ns = now_ns + HEAT_EVERY_NS
            fet, motor = self.thermistors()
        if now_ns >= self._supply_at_ns:  # a driver requests it periodically
            self._supply_at_ns = now_ns + SUPPLY_EVERY_NS
            self._supply_v = bank.bus.state(a // 2)[0]
        return DriveReading(
            self._sampled_ns,
            rounded((float(pos[a]), float(pos[b])), TURNS),
            rounded((float(vel[a]), float(vel[b])), RATE),
            status,
            int(errors),
            None if self._written else (float(bank.torque[a]), float(bank.torque[b])),
            None if armed or not is_responding else self._encoder_zero(now_ns),
            fet,
            motor,
            supply_v=self._supply_v,
        )

    def _encoder_zero(self, now_ns: int) -> Pair | None:
        """Return `DriveReading.encoder_zero` once per heartbeat, as a driver requests it."""
        if now_ns < self._ask_at_ns:
            return None
        self._ask_at_ns = now_ns + ASK_EVERY_NS
        bank, per_turn = self._bank, self._counts_per_turn
        a, b = (
            (round(bank.encoder_turns[axis] * per_turn) - bank.encoder_angle(axis))
            % per_turn
            / per_turn
            for axis in self._axes
        )
        return (a, b)

    def thermistors(self) -> tuple[Pair | None, Pair | None]:
        """Return the drive's readings of output stages and motors, C; None without thermistors."""
        if self._heat_at_ns is None:
            return None, None
        heat, (a, b) = self._bank.heat, self._axes
        fet = real_readings(float(heat.fet[a]), float(heat.fet[b]))
        return fet, real_readings(float(heat.motor[a]), float(heat.motor[b]))

    def write_torque(self, torque: Pair) -> None:
        """See `Drive.write_torque`."""

        def apply() -> None:
            self._bank.input_torque[self._module] = torque

        self._send(apply)

    def write(self, target: MotorTarget) -> None:
        """See `Drive.write`. Assigning single elements costs a third of what slices cost."""
        bank, (a, b) = self._bank, self._axes

        def apply() -> None:
            bank.input_pos[a], bank.input_pos[b] = target.pos_turns
            bank.input_vel[a], bank.input_vel[b] = target.vel_turns
            bank.input_torque[a], bank.input_torque[b] = target.torque
            bank.pos_gain[a], bank.pos_gain[b] = target.pos_gain
            bank.vel_gain[a], bank.vel_gain[b] = target.vel_gain

        self._send(apply)

    def clear_errors(self) -> None:
        """See `Drive.clear_errors`."""

        def apply() -> None:
            for axis in self._axes:
                self._bank.clear_errors(axis)

        self._send(apply)

    def idle(self) -> None:
        """See `Drive.idle`."""

        def apply() -> None:
            self._bank.input_torque[self._module] = 0.0
            for axis in self._axes:
                self._bank.request_state(axis, AxisState.IDLE)

        self._send(apply)

    def set_position(self, turns: Pair) -> None:
        """See `Drive.set_position`."""

        def apply() -> None:
            for axis, turn in zip(self._axes, turns, strict=True):
                self._bank.set_count(axis, turn * self._counts_per_turn)

        self._send(apply)

    def close(self) -> None:
        """See `Drive.close`: there is no link."""

    def arm(self, *, onboard: bool) -> None:
        """See `Drive.arm`; applies the settings of the drivers' arming frames."""
        bank, module = self._bank, self._module

        def apply() -> None:
            for axis in self._axes:
                bank.clear_errors(axis)
                mode = ControlMode.POSITION if onboard else ControlMode.TORQUE
                bank.set_modes(axis, mode, InputMode.PASSTHROUGH)
            bank.vel_limit[module] = self._drive.vel_limit
            bank.current_lim[module] = self._drive.current_lim
            zero: Pair = (0.0, 0.0)
            bank.input_torque[module] = zero
            if onboard:
                bank.pos_gain[module] = bank.vel_gain[module] = zero
            for axis in self._axes:
                bank.request_state(axis, AxisState.CLOSED_LOOP_CONTROL)

        # The delay of up to two cycles between the probe and its echo is not modelled.
        self._send(apply)

    def _send(self, apply: Apply) -> None:
        """Send a row of frames if it would not have to wait, as the CAN link does."""
        now_ns = self._clock()
        if self._watch.may_send(now_ns):
            self._written = True
            self._put(now_ns, apply)

    def _put(self, now_ns: int, apply: Apply) -> None:
        """Put a row on the bus; a drive that responds receives it and feeds its watchdogs."""
        bus = self._bus
        if bus.choked:
            self._watch.refused(now_ns)
        elif bus.acknowledged:
            self._watch.carried(now_ns)
            self._receive(apply)
        else:
            self._watch.sent(now_ns)
            bus.put(now_ns, lambda: self._receive(apply))

    def _receive(self, apply: Apply) -> None:
        bank, (a, _) = self._bank, self._axes
        if bank.is_responding(a) and a not in bank.conditions.deaf:
            self._feed()
            apply()

    def _feed(self) -> None:
        self._bank.feed(*self._axes)

    def _look_after(self, now_ns: int, *, is_responding: bool) -> None:
        """Watch the bus as the CAN link does, which receives its own frames once they are sent."""
        watch, bus = self._watch, self._bus
        if is_responding:
            watch.received(now_ns)
            if bus.acknowledged and not (watch.waits or watch.unacknowledged):
                return  # nothing can be due
        if bus.acknowledged and watch.waits:
            watch.carried(now_ns)
        elif watch.restart_due(now_ns):
            bus.restart()
            watch.restarted(now_ns, done=True)
        elif watch.probe_due(now_ns):
            watch.sent(now_ns)
            bus.put(now_ns, lambda: self._receive(self._feed))
