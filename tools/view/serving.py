"""Serves a page until Ctrl-C, or from a second process beside a running fleet.

`python -m tools.view.serving PID WORDS` is `xrl WORDS`, but ends when process PID does.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from shared.config.endpoints import PORT_MAX
from shared.exceptions import FleetError
from shared.extras import require
from shared.run_directory import private_files
from shared.toml_file import Range
from tools.flags import Arg, Flags
from tools.fleet.procfs import die_with_parent
from tools.terminal import Console
from tools.view.frame import HOST, PORT, Source

_END_S = 5.0


class PortFlags(Flags):
    """Port of the page's server."""

    port: Annotated[
        int, Range(0, PORT_MAX, ""), Arg(help=f"port on {HOST}; 0: any free one (default: {PORT})")
    ] = PORT


def serve(source: Source, port: int) -> None:
    """Serve until Ctrl-C or SIGTERM, and print the address."""
    asyncio.run(_serve(source, port))


async def _serve(source: Source, port: int) -> None:
    require("view")
    from tools.view.server import ViewServer  # noqa: PLC0415 - needs the extra

    server = ViewServer(source, port)
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    async with server.running():
        Console().print(f"{server.address}  (Ctrl-C ends it)", soft_wrap=True)
        await ended.wait()


@contextlib.contextmanager
def served_beside(run_dir: Path, port: int) -> Iterator[str]:
    """Serve a running fleet's page, which may act, from another process; end that process."""
    command = [sys.executable, "-m", "tools.view.serving", str(os.getpid())]
    command += ["view", "--act", "--run-dir", str(run_dir), "--port", str(port)]
    log = run_dir / "logs" / "view.log"
    with private_files(), log.open("wb") as said:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=said,
            text=True,
            start_new_session=True,  # Ctrl-C in the terminal is only for the parent
        )
    try:
        assert process.stdout is not None  # noqa: S101 - it is a pipe
        address = process.stdout.readline().partition(" ")[0]
        if not address:
            why = log.read_text(encoding="utf-8", errors="replace").strip()
            raise FleetError(why.removeprefix("xrl: ") or "the page's server has ended")
        yield address
    finally:
        process.terminate()
        try:
            process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def main() -> int:
    """Run the verb, and end with the parent process."""
    from tools import cli  # noqa: PLC0415 - which loads this module for its verb

    parent, *words = sys.argv[1:]
    die_with_parent(int(parent), signal.SIGTERM)
    return cli.main(words)


if __name__ == "__main__":
    sys.exit(main())
