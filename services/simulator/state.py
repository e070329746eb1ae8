"""Snapshots of the simulated world and its drives, taken and restored. Pure."""

from __future__ import annotations

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.physics.led_hand import LedHand
from services.simulator.physics.world import World
from shared.bus.traces import SimState
from shared.can.cansimple import AxisState
from shared.joints import N_JOINTS


def taken(world: World, bank: AxisBank, t_ns: int, seq: int) -> SimState:
    """Return the state of world and drives as it is.

    Args:
        world: between two steps.
        bank: its drives.
        t_ns: monotonic time.
        seq: number of the message.
    """
    data = world.data
    armed = [int(state == AxisState.CLOSED_LOOP_CONTROL) for state in bank.state]
    columns = (
        bank.input_pos,
        bank.input_vel,
        bank.input_torque,
        bank.pos_gain,
        bank.vel_gain,
        bank.counts_from,
    )
    inputs = [tuple(column.tolist()) for column in columns]
    return SimState(
        t_ns=t_ns,
        seq=seq,
        scenario_s=world.scenario_s,
        qpos=tuple(data.qpos.tolist()),
        qvel=tuple(data.qvel.tolist()),
        warmstart=tuple(data.qacc_warmstart.tolist()),
        hoist=world.hoist,
        armed=tuple(armed),
        input_pos=inputs[0],
        input_vel=inputs[1],
        input_torque=inputs[2],
        pos_gain=inputs[3],
        vel_gain=inputs[4],
        counts_from=inputs[5],
        hidden=world.hidden(),
        hand=(world.led_hand or LedHand()).state(),
    )


def restored(world: World, bank: AxisBank, state: SimState) -> None:
    """Go on from a state.

    Errors and conditions of the drives are not in it: an axis that is not armed is idle.

    Args:
        world: new, of the same robot and scenario.
        bank: new, of the same robot; not stepped yet.
        state: of a run.
    """
    world.go_on(
        state.qpos, state.qvel, state.warmstart, state.scenario_s, state.hoist, state.hidden
    )
    world.led_hand = LedHand.restored(state.hand) if any(state.hand) else None
    bank.counts_from[:] = state.counts_from
    bank.step(world.time, *world.motor_turns())
    for axis in range(N_JOINTS):
        if state.armed[axis]:
            bank.request_state(axis, AxisState.CLOSED_LOOP_CONTROL)
    bank.input_pos[:], bank.input_vel[:] = state.input_pos, state.input_vel
    bank.input_torque[:] = state.input_torque
    bank.pos_gain[:], bank.vel_gain[:] = state.pos_gain, state.vel_gain
