"""What is said where no network proxy answers: why not, and the way out."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.exceptions import FleetError
from tests.tools.fleet.plans import plan
from tools.fleet.proxy_client import ProxyClient
from tools.fleet.run_dir import RunDir


@pytest.mark.parametrize(
    ("injected", "words"),
    [
        (None, r"no fleet is up in .*; `xrl up --injectable` starts one"),
        (False, "has no network proxy; run `xrl down`, then"),
        (True, "every impairment has ended; run `xrl status`"),
    ],
    ids=["no fleet", "a fleet without a proxy", "a proxy that is down"],
)
def test_where_no_proxy_answers_it_says_why_and_the_way_out(
    run_dir: Path, injected: bool | None, words: str
) -> None:
    run_dir.mkdir()
    folder = RunDir(run_dir)
    if injected is not None:
        folder.prepare(plan(run_dir, injected=injected))
        folder.supervisor_socket.touch()
    with pytest.raises(FleetError, match=words):
        ProxyClient(run_dir).list()
