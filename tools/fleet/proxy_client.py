"""Client of the network proxy of a running fleet."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Final

import msgspec

from shared.config.scenarios import Inject
from shared.exceptions import FleetError
from shared.network.proxy_protocol import (
    SOCKET,
    Begin,
    Clear,
    List,
    Reply,
    Request,
    RequestedImpairment,
)
from shared.run_directory import live_dir
from tools.fleet.run_dir import RunDir

_PATIENCE_S: Final = 2.0
_decode = msgspec.json.Decoder(Reply).decode


class ProxyClient:
    """Client that opens a new connection for each request."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir, self._path = run_dir, live_dir(run_dir) / SOCKET

    def begin(self, inject: Inject, in_s: float = 0.0) -> tuple[RequestedImpairment, ...]:
        """Start an impairment after a delay, s; return all impairments."""
        return self._ask(Begin(inject, in_s))

    def clear(self, link: str) -> tuple[RequestedImpairment, ...]:
        """End every impairment of a link; return those that remain."""
        return self._ask(Clear(link))

    def list(self) -> tuple[RequestedImpairment, ...]:
        """Return all impairments."""
        return self._ask(List())

    def _ask(self, request: Request) -> tuple[RequestedImpairment, ...]:
        try:
            with socket.socket(socket.AF_UNIX) as asking:
                asking.settimeout(_PATIENCE_S)
                asking.connect(str(self._path))
                asking.sendall(msgspec.json.encode(request) + b"\n")
                with asking.makefile("rb") as answers:
                    line = answers.readline()
        except (FileNotFoundError, ConnectionRefusedError):
            raise FleetError(self._why_absent()) from None
        except OSError as error:
            kill = "`xrl kill network_proxy`"
            out = f"run {kill[:-1]} --signal CONT` if it was stopped, else {kill}"
            text = f"{self._path}: the network proxy does not answer: {error}; {out}"
            raise FleetError(text) from None
        if not line:
            raise FleetError(
                f"{self._path}: the network proxy ended without answering; see its log"
            )
        try:
            reply = _decode(line)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            text = f"{self._path}: this answer is not from a network proxy of this version: {error}"
            raise FleetError(text) from None
        if reply.error:
            raise FleetError(f"refused: {reply.error}")
        return reply.requested

    def _why_absent(self) -> str:
        """Return why the proxy does not listen, and the remedy."""
        folder = RunDir(self._run_dir)
        manifest = folder.read_manifest()
        if manifest is None or not folder.supervisor_socket.exists():
            return (
                f"no fleet is up in {folder.path}; `xrl up --injectable` starts one for injection"
            )
        if "network_proxy" not in manifest.services:
            return (
                f"the fleet in {folder.path} has no network proxy; run `xrl down`, then "
                "`xrl up --injectable`"
            )
        return (
            f"the network proxy in {folder.path} is down or restarting, and every impairment "
            "has ended; run `xrl status`, then `xrl start network_proxy`"
        )
