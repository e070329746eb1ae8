"""X.509 certificates on P-256 for Zenoh's TLS library, rustls."""

from __future__ import annotations

import datetime as dt
import ipaddress
from collections.abc import Sequence
from typing import Final, NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

AUTHORITY_DAYS: Final = 3650
CERTIFICATE_DAYS: Final = 730
_EARLIER: Final = dt.timedelta(days=1)
"""Certificates become valid one day before they are made, because hosts' clocks differ."""


class Issued(NamedTuple):
    """A certificate and its private key, as PEM."""

    certificate: bytes
    key: bytes


class Details(NamedTuple):
    """Contents of a certificate."""

    common_name: str
    begins: dt.datetime
    expires: dt.datetime
    hosts: tuple[str, ...]


def make_authority(robot: str, now: dt.datetime) -> Issued:
    """Return a new authority for the certificates of one robot."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"{robot} authority")
    usage = x509.KeyUsage(
        digital_signature=False, content_commitment=False, key_encipherment=False,
        data_encipherment=False, key_agreement=False, key_cert_sign=True, crl_sign=True,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip
    certificate = (
        _builder(name, name, key, now, AUTHORITY_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .sign(key, hashes.SHA256())
    )
    return _issued(certificate, key)


def issue(
    authority: Issued,
    common_name: str,
    hosts: Sequence[str],
    now: dt.datetime,
    days: int = CERTIFICATE_DAYS,
) -> Issued:
    """Return a new certificate, for the dialling or the listening side of a link.

    The access rules use the common name (`shared.bus.security.common_name`). The dialling side
    checks the names and addresses in `hosts`.
    """
    signer = serialization.load_pem_private_key(authority.key, password=None)
    if not isinstance(signer, ec.EllipticCurvePrivateKey):
        raise TypeError("the authority's key is not an elliptic-curve key")
    parent = x509.load_pem_x509_certificate(authority.certificate)
    key = ec.generate_private_key(ec.SECP256R1())
    usages = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    builder = (
        _builder(_name(common_name), parent.subject, key, now, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
    )
    if hosts:
        names = x509.SubjectAlternativeName([_general_name(host) for host in hosts])
        builder = builder.add_extension(names, critical=False)
    return _issued(builder.sign(signer, hashes.SHA256()), key)


def read(certificate: bytes) -> Details:
    """Return the contents of a certificate."""
    found = x509.load_pem_x509_certificate(certificate)
    (name,) = found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    hosts: list[str] = []
    try:
        names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        pass
    else:
        hosts += names.get_values_for_type(x509.DNSName)
        hosts += [str(address) for address in names.get_values_for_type(x509.IPAddress)]
    begins, expires = found.not_valid_before_utc, found.not_valid_after_utc
    return Details(str(name.value), begins, expires, tuple(hosts))


def is_signed_by(certificate: bytes, authority: bytes) -> bool:
    """Return True if an authority signed a certificate."""
    try:
        x509.load_pem_x509_certificate(certificate).verify_directly_issued_by(
            x509.load_pem_x509_certificate(authority)
        )
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True


def is_key_of(key: bytes, certificate: bytes) -> bool:
    """Return True if a private key belongs to a certificate."""
    try:
        own = serialization.load_pem_private_key(key, password=None).public_key()
    except (ValueError, TypeError):
        return False
    return own == x509.load_pem_x509_certificate(certificate).public_key()


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    now: dt.datetime,
    days: int,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(now + dt.timedelta(days=days))
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _issued(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> Issued:
    return Issued(
        certificate.public_bytes(serialization.Encoding.PEM),
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        ),
    )
