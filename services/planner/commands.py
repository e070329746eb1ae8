"""Builds the six commands of a tick. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from services.planner.certificate import Margins
from services.planner.hocca import LawOutput
from shared.joints import MODULES, N_MODULES
from shared.limp_leg_support import Support
from shared.messages import JointCommand, JointState, Pair


class CommandHeader(NamedTuple):
    """Fields that the six commands of a tick share."""

    now_ns: int
    seq: int
    session: int
    hold: bool
    margins: Margins


def commands_of(
    header: CommandHeader, states: Sequence[JointState], output: LawOutput, support: Support
) -> list[JointCommand]:
    """Return the commands, in the order of `MODULES`.

    Args:
        header: fields that all commands share.
        states: the newest of each module; its stamp is echoed.
        output: of the law.
        support: which modules are to stiffen to support a limp one.
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
        _command(header, state.t_ns, rows, stiffen=support.includes(module))
        for module, state, rows in zip(MODULES, states, by_module, strict=True)
    ]


def _command(
    header: CommandHeader, echo_t_ns: int, rows: list[list[float]], *, stiffen: bool
) -> JointCommand:
    pairs: list[Pair] = [(row[0], row[1]) for row in rows]
    return JointCommand(
        t_ns=header.now_ns,
        seq=header.seq,
        session=header.session,
        echo_t_ns=echo_t_ns,
        hold=header.hold,
        q_ref=pairs[0],
        v_ref=pairs[1],
        tau_ff=pairs[2],
        dtau_ff=pairs[3],
        tau_coupled=pairs[4],
        k_p=pairs[5],
        k_d=pairs[6],
        margin=header.margins.service,
        margin_onboard=header.margins.onboard,
        stiffen=stiffen,
    )
