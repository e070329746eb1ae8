"""iceoryx2: a service of bytes in shared memory for each key, with a buffer of one sample."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import iceoryx2 as iox2

from tools.lab.bench.transports.base import Put, Take

PAYLOAD_MAX = 4096


class OverIceoryx2:
    """A node; its services carry the folder's name, so two runs do not meet."""

    def __init__(self, folder: Path) -> None:
        """Open a node."""
        iox2.set_log_level(iox2.LogLevel.Fatal)
        self._prefix = folder.name
        self._node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)

    def publisher(self, key: str) -> Put:
        """See `Transport.publisher`."""
        end = self._service(key).publisher_builder().initial_max_slice_len(PAYLOAD_MAX).create()

        def put(payload: bytes) -> None:
            sample = end.loan_slice_uninit(len(payload))
            ctypes.memmove(sample.payload_ptr, payload, len(payload))
            sample.assume_init().send()

        return put

    def latest(self, key: str) -> Take:
        """See `Transport.latest`."""
        end = self._service(key).subscriber_builder().buffer_size(1).create()

        def take() -> bytes | None:
            sample = end.receive()
            if sample is None:
                return None
            payload = sample.payload()
            taken = ctypes.string_at(payload.data_ptr, payload.len())
            sample.delete()
            return taken

        return take

    def close(self) -> None:
        """Leave: services end with the process."""

    def _service(self, key: str) -> Any:
        name = iox2.ServiceName.new(f"{self._prefix}/{key}")
        slices = iox2.Slice[ctypes.c_uint8]
        builder = self._node.service_builder(name).publish_subscribe(slices)
        return builder.subscriber_max_buffer_size(1).enable_safe_overflow(True).open_or_create()


def open_transport(_process: str, folder: Path) -> OverIceoryx2:
    """Join the services of a folder."""
    return OverIceoryx2(folder)
