"""The one exception tree.

Exceptions are for start-up, tools and files. On the control path a fault is a state and an event
(docs/architecture.md#age-rule), never an exception.
"""

from __future__ import annotations


class XrlError(Exception):
    """Root of the errors that this project raises.

    The message says what was wrong, where, and what to do. Command line tools print it as one line
    and exit with `exit_code`.
    """

    exit_code = 2


class ConfigError(XrlError):
    """A configuration or scenario file holds something that cannot be used."""

    def __init__(self, file: str, key: str, found: str, expected: str) -> None:
        """Name the file, the dotted key, what stands there and what would be right."""
        super().__init__(f"{file}: {key}: {found}; {expected}")
        self.file = file
        self.key = key
        self.found = found
        self.expected = expected


class BusError(XrlError):
    """The bus could not be opened, or a message could not be put on it."""


class NonFiniteError(BusError):
    """A message holds a number that is not finite; it was not sent."""


class DriveError(XrlError):
    """A motor drive did not answer as its protocol says."""


class FleetError(XrlError):
    """The services could not be started, found or stopped."""


class RunError(XrlError):
    """A run could not be carried out or its record could not be read."""
