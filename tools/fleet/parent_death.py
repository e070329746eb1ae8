"""supervisord under PR_SET_PDEATHSIG: no service outlives its supervisor, whatever kills it.

`python -m tools.fleet.parent_death [--parent PID] -- SUPERVISORD ARGUMENTS`. The kernel kills each
service (SIGKILL) when the supervisor dies. With `--parent`, it signals the supervisor to stop the
fleet when that process dies.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import signal
from typing import Final

from supervisor import supervisord
from supervisor.options import ServerOptions

_PR_SET_PDEATHSIG: Final = 1
_prctl = ctypes.CDLL(None, use_errno=True).prctl


def die_with_parent(parent_pid: int, number: signal.Signals) -> None:
    """Have the kernel send this process a signal when its parent dies.

    Also when the parent is dead already: it may have died before this call.
    """
    if _prctl(_PR_SET_PDEATHSIG, int(number), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent_pid:
        os.kill(os.getpid(), number)


class LeashedOptions(ServerOptions):  # type: ignore[misc]  # supervisor has no types
    """supervisord's options and system calls, with the leash on each child."""

    def setpgrp(self) -> None:
        """Put the leash on; supervisord calls this in the child, first thing after fork."""
        super().setpgrp()
        die_with_parent(self._supervisor_pid, signal.SIGKILL)

    def cleanup_fds(self) -> None:
        """Keep the inherited descriptors: one of them holds the run directory's lock."""

    _supervisor_pid = os.getpid()


def main() -> None:
    """Run supervisord in this process until it is stopped."""
    # The tool that starts us blocks signals meanwhile, and a mask is inherited.
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parent", type=int, help="stop the fleet when this process dies")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="for supervisord, after --")
    args = parser.parse_args()
    if args.parent is not None:
        die_with_parent(args.parent, signal.SIGTERM)
    supervisord.ServerOptions = LeashedOptions
    supervisord.main([word for word in args.arguments if word != "--"])


if __name__ == "__main__":
    main()
