"""The six commands of a tick, as they are sent. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from services.planner.certificate import Margins
from services.planner.hocca import LawOutput
from shared.joints import MODULES, N_MODULES
from shared.limp_leg_support import Support
from shared.messages import JointCommand, JointState, Pair


class Common(NamedTuple):
    """What the six commands of a tick have in common."""

    now_ns: int
    seq: int
    session: int
    hold: bool
    margins: Margins


def commands_of(
    common: Common, states: Sequence[JointState], output: LawOutput, support: Support
) -> list[JointCommand]:
    """Return the commands, in the order of `MODULES`.

    Args:
        common: what all tell.
        states: the newest of each module; its stamp is echoed.
        output: what the law found.
        support: which modules are to stiffen, beside a limp one.
    """
    rows = np.array(
        (
            output.q_ref,
            output.v_ref,
            output.tau_ff,
            output.dtau_ff,
            output.tau_coupled,
            output.local.D,
            output.local.D_B,
        )
    ).reshape(7, N_MODULES, 2)
    by_module = rows.transpose(1, 0, 2).tolist()
    return [
        _command(common, state.t_ns, rows, stiffen=support.includes(module))
        for module, state, rows in zip(MODULES, states, by_module, strict=True)
    ]


def _command(
    common: Common, echo_t_ns: int, rows: list[list[float]], *, stiffen: bool
) -> JointCommand:
    pairs: list[Pair] = [(row[0], row[1]) for row in rows]
    return JointCommand(
        t_ns=common.now_ns,
        seq=common.seq,
        session=common.session,
        echo_t_ns=echo_t_ns,
        hold=common.hold,
        q_ref=pairs[0],
        v_ref=pairs[1],
        tau_ff=pairs[2],
        dtau_ff=pairs[3],
        tau_coupled=pairs[4],
        k_p=pairs[5],
        k_d=pairs[6],
        margin=common.margins.service,
        margin_onboard=common.margins.onboard,
        stiffen=stiffen,
    )
