"""Who may talk to the phone page: one-time tokens, sessions, and a certificate made on the spot."""

import datetime
import hmac
import ipaddress
import secrets
import socket
import ssl
import tempfile
from pathlib import Path
from typing import final

from capture.input_error import InputError


@final
class AccessControl:
    """Tokens that open the page once, and the sessions that they begin."""

    def __init__(self) -> None:
        """Make the first token."""
        self.token = secrets.token_urlsafe(12)
        self._sessions: set[str] = set()

    def enter(self, token: str) -> str | None:
        """Exchange a token for a session, once; None if it is not valid."""
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            return None
        self.token = secrets.token_urlsafe(12)
        session = secrets.token_urlsafe(24)
        self._sessions.add(session)
        return session

    def is_known(self, session: str) -> bool:
        """Return whether a session was begun with a token."""
        return session in self._sessions


def local_address() -> str:
    """The address of this machine in its network; the loopback address without one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing: only the route is looked up
        except OSError:
            return "127.0.0.1"
        return probe.getsockname()[0]


def made_certificate(address: str) -> ssl.SSLContext:
    """Make a certificate for an address or a name, which no authority has signed."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "ia-capture")])
    now = datetime.datetime.now(datetime.UTC)
    names = {x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))}
    try:
        names.add(x509.IPAddress(ipaddress.ip_address(address)))
    except ValueError:
        names.add(x509.DNSName(address))
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=7))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(  # Apple's systems refuse a server without it
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False
        )
        .sign(key, hashes.SHA256())
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "certificate.pem"
        path.touch(mode=0o600)
        path.write_bytes(
            certificate.public_bytes(serialization.Encoding.PEM)
            + key.private_bytes(
                serialization.Encoding.PEM,
                serialization.PrivateFormat.PKCS8,
                serialization.NoEncryption(),
            )
        )
        return load_certificate(path, path)


def load_certificate(certificate: Path, key: Path) -> ssl.SSLContext:
    """Load a certificate and its key; an InputError if they are none, or do not belong together."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(certificate, key)
    except ssl.SSLError as error:
        raise InputError(
            f"--cert {certificate} and --key {key} cannot be used: {error.reason or error}. "
            "Both must be PEM files, and the key that of the certificate."
        ) from None
    return context
