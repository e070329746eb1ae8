"""The figures that a run is judged by, and their limits."""

from __future__ import annotations

from typing import Final, NamedTuple


class VerdictLimit(NamedTuple):
    """One row of the verdict table."""

    key: str
    limit: float
    unit: str
    what: str


LIMITS: Final = (
    VerdictLimit("alive_com_x_max_mm", 20.0, "mm", "COM x, led"),
    VerdictLimit("alive_com_y_max_mm", 10.0, "mm", "COM y, led"),
    VerdictLimit("alive_roll_max_rad", 0.02, "rad", "roll, led"),
    VerdictLimit("alive_yaw_max_rad", 0.02, "rad", "yaw, led"),
    VerdictLimit("alive_sole_tilt_max_rad", 0.02, "rad", "soles' tilt, led"),
    VerdictLimit("torque_at_limit_ms", 50.0, "ms", "module's torque at its limit, longest"),
    VerdictLimit("shaking_nm", 15.0, "N m", "torque above 8 Hz, root mean square"),
    VerdictLimit("sinking_m_s", 0.8, "m/s", "torso's fastest way down"),
    VerdictLimit("operator_peak_n", 40.0, "N", "operator's force, led"),
    VerdictLimit("assist_error_n", 10.0, "N", "assist force against what was asked"),
    VerdictLimit("hold_com_x_max_mm", 80.0, "mm", "COM x, held"),
    VerdictLimit("hold_com_y_max_mm", 100.0, "mm", "COM y, held"),
    VerdictLimit("handover_max_ms", 65.0, "ms", "kill to HOLD, slowest module"),
    VerdictLimit("handover_torque_step_nm", 5.0, "N m", "torque step at hand-over"),
    VerdictLimit("reengage_s", 1.5, "s", "restart to TRACK, slowest module"),
    VerdictLimit("pd_cycles_late_pct", 0.5, "%", "PD cycles later than two periods"),
    VerdictLimit("fleet_cpu_pct", 160.0, "%", "CPU of all processes, of 200"),
    VerdictLimit("sequence_gaps", 0.0, "", "messages lost on the way to the log"),
)
"""Live targets. Only `stood` decides the exit code: to the end, standing then
(`tools.judge.standing`), and soundly all the way (`SOUND`). `led`: all six modules track, before
any kill; `held`: after a kill, or in HOLD by an impaired network. What a stall of the machine made
of a run counts as neither (`tools.judge.stalls`)."""

SOUND: Final = ("torque_at_limit_ms", "shaking_nm", "sinking_m_s")
"""A run in which one of these is over its limit did not stand. The limit of sinking: a person who
catches up with a robot that held leads it down at up to 0.73 m/s (`bad_network`)."""
