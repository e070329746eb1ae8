"""Blocking access to ODrives over USB with the genuine `odrive` package.

The package runs on an asyncio loop in its own thread. Every call is passed to that loop and has a
timeout. `UsbBus` needs libusb-1.0.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine, Iterable, Mapping
from concurrent.futures import CancelledError
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any, Final, TypeVar

from odrive.async_tree import AsyncProperty
from odrive.device_manager import (
    DeviceManagerDelegate,
    FilterSpec,
    Subscription,
)
from odrive.libodrive import DeviceType
from odrive.runtime_device import RuntimeDevice

from services.joint.drivers.odrive_usb import device_manager
from shared.can.drive_settings import AXES
from shared.exceptions import DriveError
from tools.bringup.boards import Board, FoundBoards, Value, describe_firmware, number

FIND_S: Final = 3.0
"""Timeout for boards to appear, s; discovery takes a few tenths of a second."""
CONNECT_S: Final = 15.0
"""Timeout for a connection, s; an unknown board first sends its table of endpoints."""
TRANSFER_S: Final = 5.0
LEAVE_S: Final = 5.0
"""Timeout from `save_configuration` until the board disconnects, s; it first writes its flash."""
RETURN_S: Final = 15.0
"""Timeout for the board to reconnect, s."""

_POLL_S = 0.02
_ENDPOINT = "endpoint_ref"

T = TypeVar("T")


class UsbBus:
    """The ODrives on this machine's USB."""

    def __init__(self) -> None:
        self._manager = device_manager()
        self._present: dict[str, Any] = {}
        """Boards that are plugged in, by serial number; written by the package's loop."""
        self._boards: list[UsbBoard] = []
        self._subscription: Subscription = self.run(self._watch(), TRANSFER_S)

    def open(self, serial_numbers: Iterable[str], timeout_s: float = FIND_S) -> FoundBoards:
        """Connect to boards by serial number, once all are plugged in or the timeout has passed."""
        wanted = [serial.upper() for serial in serial_numbers]
        results = self.run(self._connect_all(wanted, timeout_s), timeout_s + CONNECT_S + TRANSFER_S)
        boards: dict[str, Board] = {}
        troubles: dict[str, str] = {}
        for serial, result in zip(wanted, results, strict=True):
            if isinstance(result, RuntimeDevice):
                board = UsbBoard(self, result)
                self._boards.append(board)
                boards[serial] = board
            else:
                troubles[serial] = result
        return FoundBoards(boards, troubles, tuple(sorted(set(self._present) - set(wanted))))

    def close(self) -> None:
        """Release all boards; later calls on them fail."""
        with contextlib.suppress(DriveError):
            self.run(self._leave(), TRANSFER_S)

    def run(self, coroutine: Coroutine[Any, Any, T], timeout_s: float) -> T:
        """Run a coroutine on the package's loop and return its result."""
        task = asyncio.run_coroutine_threadsafe(coroutine, self._manager.loop)
        try:
            return task.result(timeout_s)
        except (FutureTimeoutError, CancelledError):
            raise DriveError(f"USB: no answer within {timeout_s:g} s") from None
        except DriveError:
            raise
        except Exception as error:
            raise DriveError(f"USB: {describe(error)}") from error
        finally:
            task.cancel()

    async def connect_again(self, before: RuntimeDevice) -> RuntimeDevice:
        """Wait until a restarting board disconnects and reconnects, and connect to it."""
        serial = before.serial_number
        if not await self._until(lambda: self._present.get(serial) is not before.device, LEAVE_S):
            raise DriveError(
                f"ODrive {serial} did not restart within {LEAVE_S:g} s: its settings may not have "
                "been saved; check whether one of its axes is armed"
            )
        if not await self._until(lambda: serial in self._present, RETURN_S):
            raise DriveError(
                f"ODrive {serial} did not reconnect within {RETURN_S:g} s after its restart; check "
                "its cable and supply"
            )
        result = await self._connect(serial)
        if isinstance(result, str):
            raise DriveError(f"ODrive {serial} restarted, but the connection failed: {result}")
        return result

    async def _watch(self) -> Subscription:
        """Subscribe to boards that come and go, to keep `_present` up to date."""
        delegate: Any = DeviceManagerDelegate()
        delegate.on_found_device = self._on_found
        delegate.on_lost_device = self._on_lost
        spec = FilterSpec(device_types=[DeviceType.RUNTIME])
        return self._manager.subscribe(spec, delegate, debug_name="xrl")

    def _on_found(self, device: Any) -> None:
        self._present[device.info.serial_number] = device

    def _on_lost(self, device: Any) -> None:
        serial = device.info.serial_number
        if self._present.get(serial) is device:
            del self._present[serial]

    async def _until(self, claim: Callable[[], bool], timeout_s: float) -> bool:
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout_s
        while not claim():
            if loop.time() > deadline:
                return False
            await asyncio.sleep(_POLL_S)
        return True

    async def _connect_all(
        self, serials: Iterable[str], timeout_s: float
    ) -> list[RuntimeDevice | str]:
        wanted = set(serials)
        await self._until(lambda: wanted <= set(self._present), timeout_s)
        return await asyncio.gather(*(self._connect(serial) for serial in serials))

    async def _connect(self, serial: str) -> RuntimeDevice | str:
        """Return a board, or why the connection failed."""
        device = self._present.get(serial)
        if device is None:
            return "not plugged in"
        try:
            connected = await asyncio.wait_for(self._manager.use_connection(device), CONNECT_S)
        except TimeoutError:
            return f"plugged in, but silent for {CONNECT_S:g} s"
        except Exception as error:  # noqa: BLE001 - the package raises bare Exceptions
            return f"plugged in, but: {describe(error)}"
        return connected if isinstance(connected, RuntimeDevice) else "not a running ODrive"

    async def _leave(self) -> None:
        for board in self._boards:
            with contextlib.suppress(Exception):  # it may be disconnected already
                self._manager.release_connection(board.device)
        self._boards.clear()
        self._manager.unsubscribe(self._subscription)


class UsbBoard:
    """One ODrive on USB; implements `tools.bringup.boards.Board`."""

    def __init__(self, bus: UsbBus, device: RuntimeDevice) -> None:
        self._bus = bus
        self.device = device

    @property
    def serial_number(self) -> str:
        """See `Board`."""
        return str(self.device.serial_number)

    @property
    def firmware(self) -> tuple[int, int, int]:
        """See `Board`; 0.0.0 if the board does not report it."""
        major, minor, revision = self.device.fw_version or (0, 0, 0)
        return int(major), int(minor), int(revision)

    @property
    def settings(self) -> tuple[str, ...]:
        """See `Board`."""
        return tuple(
            name
            for name, entry in self.device.properties.items()
            if entry.writable and ".config." in f".{name}."
        )

    def read(self, names: Iterable[str]) -> dict[str, Value]:
        """See `Board`."""
        present = [name for name in names if name in self.device.properties]
        values = self._run(self.device.read_multiple(present), "read")
        return {name: self._named(value) for name, value in zip(present, values, strict=True)}

    def write(self, values: Mapping[str, Value]) -> None:
        """See `Board`.

        Raises:
            DriveError: also if the board lacks an endpoint; nothing is written then.
        """
        missing = [name for name in values if name not in self.device.properties]
        if missing:
            raise DriveError(
                f"ODrive {self.serial_number}, firmware {describe_firmware(self.firmware)}: "
                f"has no {missing[0]}"
            )
        self._run(self._write(values), "write")

    def save(self) -> None:
        """See `Board`."""
        self._restart("save_configuration")

    def restart(self) -> None:
        """See `Board`."""
        self._restart("reboot")

    def clear_errors(self) -> None:
        """See `Board`."""
        self._run(self.device.call_function("clear_errors"), "clear_errors")

    def states(self) -> tuple[int, int]:
        """See `Board`."""
        names = [f"{axis}.current_state" for axis in AXES]
        values = self.read(names)
        first, second = (int(number(values, name)) for name in names)
        return first, second

    def _run(
        self, coroutine: Coroutine[Any, Any, T], what: str, timeout_s: float = TRANSFER_S
    ) -> T:
        try:
            return self._bus.run(coroutine, timeout_s)
        except DriveError as error:
            raise DriveError(f"ODrive {self.serial_number}: {what}: {error}") from error

    async def _write(self, values: Mapping[str, Value]) -> None:
        for name, value in values.items():
            entry = self.device.properties[name]
            if entry.codec_name == _ENDPOINT and isinstance(value, str):
                await self.device.write(entry, self.device.get_async_property(value))
            else:
                await self.device.write(entry, value)

    def _restart(self, function: str) -> None:
        """Call a function that restarts the board, and connect to it again."""
        self.device = self._run(self._left(function), function, LEAVE_S + RETURN_S + CONNECT_S)

    async def _left(self, function: str) -> RuntimeDevice:
        # The board restarts before it answers.
        with contextlib.suppress(Exception):
            await asyncio.wait_for(self.device.call_function(function), LEAVE_S)
        return await self._bus.connect_again(self.device)

    def _named(self, value: Any) -> Value:
        """Convert a value to a `Value`: an endpoint becomes its name."""
        if isinstance(value, AsyncProperty):
            return str(self.device.path_of(value._info))  # noqa: SLF001 - no public access
        plain: Value = value
        return plain


def describe(error: BaseException) -> str:
    """Describe an exception of the package in one line."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
