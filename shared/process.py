"""Common parts of every service's `__main__`: arguments, stopping, errors."""

from __future__ import annotations

import argparse
import gc
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

from shared import log, places
from shared.arguments import FlagParser
from shared.exceptions import BUG_EXIT_CODE, XrlError, os_error_in_words
from shared.run_directory import default_run_dir, service_directory

SOCKET_PATH_MAX = 100
"""Maximum length of a UNIX socket's path that works everywhere; the kernel allows 107 bytes."""


def service_parser(description: str, example: str) -> argparse.ArgumentParser:
    """Return a parser with the arguments of every service."""
    parser = FlagParser(
        description=description,
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--config", type=places.config_argument, default=places.NOT_NAMED, help=places.HELP
    )
    parser.add_argument(
        "--run-dir",
        type=service_directory,
        default=str(default_run_dir()),
        help="run directory of the fleet",
    )
    return parser


def add_injected(parser: argparse.ArgumentParser) -> None:
    """Add the flag of a service whose links can pass through the network proxy."""
    parser.add_argument(
        "--injected",
        action="store_true",
        help="connect through the network proxy (services.network_proxy)",
    )


class StopFlag:
    """True once SIGTERM or SIGINT was received; the loops check it once a cycle."""

    def __init__(self, *also: signal.Signals) -> None:
        """Handle SIGTERM, SIGINT and the signals in `also`."""
        self.stopped = False
        self.interrupted = False
        """True if SIGINT was received: the whole fleet stops, not only this process."""
        for number in (signal.SIGTERM, signal.SIGINT, *also):
            signal.signal(number, self._stop)

    def _stop(self, number: int, _frame: FrameType | None) -> None:
        self.stopped = True
        self.interrupted |= number == signal.SIGINT

    def __bool__(self) -> bool:
        """Return True if the process must stop."""
        return self.stopped


def freeze_garbage() -> None:
    """Switch the cyclic garbage collector off after start-up, so that it never pauses control."""
    gc.collect()
    gc.freeze()
    gc.disable()


def run_service(main: Callable[[], int]) -> None:
    """Run a service's main; log an error in one line, a bug with its traceback, and exit.

    Files that the service creates are private to this user.
    """
    os.umask(0o077)
    try:
        sys.exit(main())
    except XrlError as error:
        log.get("xrl").error("%s", error)
        sys.exit(error.exit_code)
    except OSError as error:
        log.get("xrl").error("%s", os_error_in_words(error), exc_info=error.filename is None)
        sys.exit(XrlError.exit_code)
    except Exception:  # noqa: BLE001 - Python's own exit code would be 1
        log.get("xrl").exception("this is a bug in the service; please report it")
        sys.exit(BUG_EXIT_CODE)
