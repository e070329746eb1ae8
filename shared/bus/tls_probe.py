"""Cause of a failed TLS link: Zenoh does not report it, so the handshake is repeated here."""

from __future__ import annotations

import contextlib
import datetime as dt
import socket
import ssl
from typing import Final

from shared.bus.credentials import Credentials
from shared.config.endpoints import host_and_port

_CONNECT_S: Final = 1.0
_ALERT_S: Final = 0.3
"""Wait for an alert: a listener rejects our certificate only after the handshake (RFC 8446)."""

_ALERTS: Final = {
    "CERTIFICATE_EXPIRED": "by its clock, our certificate has expired or is not valid yet",
    "UNKNOWN_CA": "it does not know the authority that signed our certificate",
    "CERTIFICATE_REQUIRED": "it requires a certificate and received none",
    "BAD_CERTIFICATE": "it rejects our certificate",
    "DECRYPT_ERROR": "our certificate was signed by another authority of the same name",
    "CERTIFICATE_UNKNOWN": "it rejects our certificate",
}
_VERDICTS: Final = {
    7: "was signed by another authority",  # certificate signature failure
    9: "is not valid yet",
    10: "has expired",
    19: "was signed by another authority",  # self-signed certificate in certificate chain
    20: "was signed by another authority",  # unable to get local issuer certificate
}
"""By OpenSSL's X509_V_ERR code, because its texts change from version to version."""


def own_fault(own: Credentials) -> str:
    """Return the fault of a certificate, judged by this host's clock and authority; "" if valid.

    The handshake is in memory, so it needs no link and no library except Python's.
    """
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        server.load_cert_chain(own.certificate, own.key)
        client = _client(own)
    except OSError as error:
        return f"cannot be read: {error}"
    client.check_hostname = False
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ours = client.wrap_bio(back, there, server_hostname=None)
    theirs = server.wrap_bio(there, back, server_side=True)
    try:
        for side in (ours, theirs, ours):
            with contextlib.suppress(ssl.SSLWantReadError):
                side.do_handshake()
    except ssl.SSLCertVerificationError as error:
        return _verdict(error)
    except ssl.SSLError as error:
        return f"is rejected: {error.reason}"
    return ""


def refusal(own: Credentials, endpoint: str) -> str:
    """Return why a link to tls/HOST:PORT fails, in words; "" if it works.

    May take seconds; not for a control loop.
    """
    host, port = host_and_port(endpoint)
    try:
        with (
            socket.create_connection((host, port), timeout=_CONNECT_S) as plain,
            _client(own).wrap_socket(plain, server_hostname=host) as link,
        ):
            link.settimeout(_ALERT_S)
            return "" if link.recv(1) else "it closes the link"
    except ssl.SSLCertVerificationError as error:
        return f"its certificate {_verdict(error)}"
    except ssl.SSLError as error:
        reason = (error.reason or "").partition("ALERT_")[2] or error.reason or str(error)
        return _ALERTS.get(reason, f"TLS: {reason}")
    except TimeoutError as error:
        return "" if str(error) == "The read operation timed out" else "no answer"
    except OSError as error:
        return error.strerror or str(error)


def _client(own: Credentials) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(own.authority)
    context.load_cert_chain(own.certificate, own.key)
    return context


def _verdict(error: ssl.SSLCertVerificationError) -> str:
    found = error.verify_message
    if "mismatch" in found:
        return f"belongs to another host ({found})"
    now = f"{dt.datetime.now(dt.UTC):%Y-%m-%d %H:%M} UTC"
    return f"{_VERDICTS.get(error.verify_code, found)} (this host's clock: {now})"
