"""The simulated world and its drives as one message, from which a run can continue. Pure."""

from __future__ import annotations

from typing import Final

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.physics.led_hand import LedHand
from services.simulator.physics.world import World
from shared.bus.traces import SimState
from shared.can.cansimple import AxisState
from shared.joints import N_JOINTS

_COLUMNS: Final = ("input_pos", "input_vel", "input_torque", "pos_gain", "vel_gain", "counts_from")
"""Arrays of the bank that the message holds by the same names."""


def read_state(world: World, bank: AxisBank, t_ns: int, seq: int) -> SimState:
    """Return the state of a world between two steps, and of its drives."""
    data = world.data
    return SimState(
        t_ns=t_ns,
        seq=seq,
        scenario_s=world.scenario_s,
        qpos=tuple(data.qpos.tolist()),
        qvel=tuple(data.qvel.tolist()),
        warmstart=tuple(data.qacc_warmstart.tolist()),
        hoist=world.hoist,
        armed=tuple(int(state == AxisState.CLOSED_LOOP_CONTROL) for state in bank.state),
        hidden=world.hidden(),
        hand=(world.outside.led_hand or LedHand()).numbers(),
        heat=bank.heat.numbers(),
        **{name: tuple(getattr(bank, name).tolist()) for name in _COLUMNS},
    )


def write_state(world: World, bank: AxisBank, state: SimState) -> None:
    """Make a new world and its drives continue from a state of the same robot and scenario.

    Errors and conditions of the drives are not in it: an axis that is not armed is idle.
    """
    world.resume(state)
    bank.heat.set_numbers(state.heat)
    bank.counts_from[:] = state.counts_from
    bank.step(world.time, *world.motor_turns())
    for axis in range(N_JOINTS):
        if state.armed[axis]:
            bank.request_state(axis, AxisState.CLOSED_LOOP_CONTROL)
    for name in _COLUMNS:
        getattr(bank, name)[:] = getattr(state, name)
