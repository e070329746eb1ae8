"""A drive driver of your own: the methods of `Drive` on a simulated motor.

A joint service needs no other methods (docs/drives.md#add-a-drive). `read` waits for the next
sample and never raises; it reports a lost link as `DriveStatus.LOST`.
Run: python examples/own_drive.py
"""

from __future__ import annotations

from services.joint.differential import joint_torque, motor_from_joint
from services.joint.drivers.base import DriveReading, MotorTarget
from shared.bus.messages import DriveStatus, Pair
from shared.clock import NS_PER_S

GEAR_RATIO = 17.5
INERTIA = 0.5  # kg m^2 at the joint
FRICTION = 2.0  # N m s/rad


class BenchDrive:
    """A module in virtual time; each `read` advances it by 2 ms."""

    def __init__(self, q: Pair, load: Pair = (0.0, 0.0)) -> None:
        """Place the joint at q (phi, theta), rad, under a load, N m."""
        self.q, self.v, self.load = list(q), [0.0, 0.0], load
        self.now_ns = NS_PER_S
        self._armed = False
        self._target: MotorTarget | None = None

    def read(self, _timeout_s: float) -> DriveReading:
        """Return the next sample of both axes, in motor turns."""
        for _ in range(20):
            self._step(1e-4)
        status = DriveStatus.ARMED if self._armed else DriveStatus.IDLE
        return DriveReading(
            self.now_ns,
            motor_from_joint((self.q[0], self.q[1]), GEAR_RATIO),
            motor_from_joint((self.v[0], self.v[1]), GEAR_RATIO),
            status,
            error=0,
        )

    def write(self, target: MotorTarget) -> None:
        """Set the targets of both motors' position loops."""
        self._target = target

    def write_torque(self, torque: Pair) -> None:
        """Set torques, with the position loops' gains at zero."""
        zero = (0.0, 0.0)
        self._target = MotorTarget(zero, zero, torque, pos_gain=zero, vel_gain=zero)

    def arm(self, *, onboard: bool) -> None:
        """Close the loop on both axes; this motor has only one kind of loop."""
        del onboard
        self._armed = True

    def clear_errors(self) -> None:
        """Clear errors; this motor has none."""

    def idle(self) -> None:
        """Open the loop, so that the motors give no torque."""
        self._armed = False

    def set_position(self, turns: Pair) -> None:
        """Set the motors' positions, as `xrl drive zero` does."""
        self.q[:] = joint_torque(turns, 1.0 / GEAR_RATIO)

    def close(self) -> None:
        """Close the link; this drive has none."""

    def _step(self, dt: float) -> None:
        self.now_ns += round(dt * NS_PER_S)
        tau = joint_torque(self._motor_torques(), GEAR_RATIO)
        for axis in (0, 1):
            pull = tau[axis] + self.load[axis] - FRICTION * self.v[axis]
            self.v[axis] += dt * pull / INERTIA
            self.q[axis] += dt * self.v[axis]

    def _motor_torques(self) -> Pair:
        """Return each motor's torque by the firmware's law, N m."""
        t = self._target
        if not self._armed or t is None:
            return (0.0, 0.0)
        pos = motor_from_joint((self.q[0], self.q[1]), GEAR_RATIO)
        vel = motor_from_joint((self.v[0], self.v[1]), GEAR_RATIO)
        a, b = (
            t.torque[i]
            + t.vel_gain[i] * (t.vel_turns[i] + t.pos_gain[i] * (t.pos_turns[i] - pos[i]) - vel[i])
            for i in (0, 1)
        )
        return (a, b)


def main() -> None:
    """Arm the drive, whose own loop then holds a target."""
    drive = BenchDrive(q=(0.0, -1.0))
    here = drive.read(0.01).pos_turns
    drive.arm(onboard=True)
    drive.write(
        MotorTarget(here, (0.0, 0.0), (0.0, 0.0), pos_gain=(20.0, 20.0), vel_gain=(1.0, 1.0))
    )
    drive.load = (0.0, 10.0)
    for _ in range(500):
        reading = drive.read(0.01)
    print(f"{reading.status.name}: theta {drive.q[1]:.4f} rad under 10 N m; it started at -1")


if __name__ == "__main__":
    main()
