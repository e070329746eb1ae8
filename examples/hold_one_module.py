"""Hold one knee with the control cycle of a joint service and the drive of `own_drive.py`.

`DriveManager.step` is one control cycle without I/O. `services/joint/loop.py` connects the same
call to a drive and the bus. Run: python examples/hold_one_module.py
"""

from __future__ import annotations

from own_drive import BenchDrive

from services.joint.drive_manager import DriveCommand, DriveManager
from shared.config.files import load
from shared.places import DEFAULT_CONFIG


def main() -> None:
    """Arm a knee, load it with 20 N m for a second, and print its mode, angle and torque."""
    robot = load(DEFAULT_CONFIG)
    knee = DriveManager(robot, "knee_left")
    drive = BenchDrive(q=(0.02, -1.0))
    for cycle in range(1000):
        drive.load = (0.0, 20.0) if 250 <= cycle < 750 else (0.0, 0.0)
        reading = drive.read(0.01)
        step = knee.step(drive.now_ns, reading, command=None, estop=False)
        if step.command is DriveCommand.ARM:
            drive.arm(onboard=knee.onboard)
        elif step.target is not None:
            drive.write(step.target)
        if step.event is not None or cycle % 250 == 249:
            now = knee.state.controller
            state = knee.controller.state(now, drive.now_ns)
            print(
                f"{cycle / 500:5.2f} s  {now.failsafe.mode.name:8}"
                f"  theta {state.q[1]:8.4f} rad  torque {state.tau[1]:7.2f} N m"
            )


if __name__ == "__main__":
    main()
