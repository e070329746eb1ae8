"""`xrl view` as a process: it prints its address, serves, and ends with Ctrl-C."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import urllib.request

import pytest

from shared.places import CHECKOUT


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_page_is_served_until_it_is_interrupted(number: signal.Signals) -> None:
    command = [sys.executable, "-m", "tools.cli", "view", "--sim", "--port", "0"]
    with subprocess.Popen(
        command, cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            found = re.match(r"(http://127\.0\.0\.1:\d+/\S+/)", process.stdout.readline())
            assert found is not None
            with urllib.request.urlopen(found[1], timeout=20) as page:  # noqa: S310 - its own
                assert b"<title>XRL</title>" in page.read()
            process.send_signal(number)
            _, error = process.communicate(timeout=20)
        finally:
            process.kill()
    assert (process.returncode, error) == (0, "")
