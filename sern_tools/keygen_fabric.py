"""`sern keygen fabric NAME...`: an authority for the relays of one fabric, and a certificate for each of them.

    ca.pem          the authority's certificate: a copy at every relay
    ca-key.pem      its key, secret: whoever has it can be any relay. It is needed only to add one; keep it elsewhere
    NAME.pem        a relay's certificate, whose common name and alternative name are the relay's name
    NAME-key.pem    its key, secret

Keys are of ECDSA on P-256. A name has no hyphen, so no relay's files have the names of another's.
"""

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.names import client_name
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.fabric import CA_FILE, CA_NAME, certificate_file, key_file
from sern_runtime.whole_file import write_whole

CA_KEY_FILE: Final = key_file(CA_NAME)
VALID_FOR: Final = datetime.timedelta(days=3650)
"""As long as the authority itself: a fleet that stops on a day that nobody remembers helps nobody. `sern check` warns
before."""
SKEW: Final = datetime.timedelta(days=1)
"""A relay's clock may be behind this machine's."""

_Key = ec.EllipticCurvePrivateKey


def make_fabric(names: Sequence[str], *, out: Path) -> str:
    """A new authority and a certificate for each name, in `out`; what the person should do next.

    Raises UsageError for a bad name, ConfigError where a file is there already or cannot be written.
    """
    relays = _relay_names(names)
    _refuse_existing(out, [CA_FILE, CA_KEY_FILE, *_files_of(relays)])
    _make_directory(out)
    key = ec.generate_private_key(ec.SECP256R1())
    authority = _authority(key)
    _write_pair(out, CA_NAME, authority, key)
    for relay in relays:
        _issue(out, relay, authority, key)
    return _advice(out, relays, made_authority=True)


def add_relays(names: Sequence[str], *, out: Path) -> str:
    """A certificate for each name by the authority that is in `out`. As `make_fabric`."""
    relays = _relay_names(names)
    authority, key = _read_authority(out)
    _refuse_existing(out, _files_of(relays))
    for relay in relays:
        _issue(out, relay, authority, key)
    return _advice(out, relays, made_authority=False)


def _relay_names(names: Sequence[str]) -> list[ClientName]:
    relays = [client_name(name) for name in names]
    if not relays:
        raise UsageError("name the relays: sern keygen fabric NAME NAME..., or --relay NAME to add one")
    for relay in relays:
        if relay == CA_NAME:
            raise UsageError(f"{CA_NAME} is the name of the authority's files; a relay needs another one")
        if relays.count(relay) > 1:
            raise UsageError(f"{relay} is named twice")
    return relays


def _files_of(relays: Sequence[ClientName]) -> list[str]:
    return [name for relay in relays for name in (certificate_file(relay), key_file(relay))]


def _refuse_existing(out: Path, names: Sequence[str]) -> None:
    for name in names:
        path = out / name
        if path.exists() or path.is_symlink():
            problem = "exists already, and is not replaced; move it away, or name another --out"
            if name in (CA_FILE, CA_KEY_FILE):
                problem = "exists already, and is not replaced; --relay NAME adds a relay to it"
            raise ConfigError(problem, file=str(path))


def _make_directory(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"can not be made: {error.strerror or error}", file=str(out)) from error


def _read_authority(out: Path) -> tuple[x509.Certificate, _Key]:
    path = out / CA_FILE
    try:
        authority = x509.load_pem_x509_certificate(path.read_bytes())
        path = out / CA_KEY_FILE
        key = serialization.load_pem_private_key(path.read_bytes(), password=None)
    except OSError as error:
        problem = f"can not be read: {error.strerror or error}; sern keygen fabric NAME... makes an authority"
        raise ConfigError(problem, file=str(path)) from error
    except (ValueError, TypeError) as error:
        raise ConfigError("is no certificate or key as sern keygen fabric makes them", file=str(path)) from error
    if not isinstance(key, _Key) or key.public_key() != authority.public_key():
        raise ConfigError(f"is not the key of {out / CA_FILE}", file=str(path))
    return authority, key


def _authority(key: _Key) -> x509.Certificate:
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "SERN fabric")])
    usage = _key_usage(signs_certificates=True)
    return (
        _builder(name, name, key)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .sign(key, hashes.SHA256())
    )


def _issue(out: Path, relay: ClientName, authority: x509.Certificate, authority_key: _Key) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, relay)])
    issuer = authority_key.public_key()
    certificate = (
        _builder(name, authority.subject, key, until=authority.not_valid_after_utc)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        # It connects and it listens.
        .add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]), critical=False
        )
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(relay)]), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer), critical=False)
        .sign(authority_key, hashes.SHA256())
    )
    _write_pair(out, relay, certificate, key)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: _Key, until: datetime.datetime | None = None
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - SKEW)
        .not_valid_after(now + VALID_FOR if until is None else until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _write_pair(out: Path, name: str, certificate: x509.Certificate, key: _Key) -> None:
    """The key first: a certificate whose key could not be written is of no use."""
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    public = certificate.public_bytes(serialization.Encoding.PEM)
    for file, text, mode in ((key_file(name), secret, 0o600), (certificate_file(name), public, 0o644)):
        path = out / file
        try:
            write_whole(path, text.decode("ascii"), mode=mode, replace=False)
        except FileExistsError as error:
            raise ConfigError("exists already, and is not replaced", file=str(path)) from error
        except OSError as error:
            raise ConfigError(f"can not be written: {error.strerror or error}", file=str(path)) from error


def _advice(out: Path, relays: Sequence[ClientName], *, made_authority: bool) -> str:
    made = [certificate_file(relay) for relay in relays]
    text = f"wrote {', '.join(made)} and their keys (secret, mode 0600) in {out}\n"
    if made_authority:
        text += f"wrote {CA_FILE} and {CA_KEY_FILE} (secret, mode 0600), the authority that signed them\n"
    first = relays[0]
    others = ", ".join(relays[1:]) or "NAMES OF THE OTHERS"
    return (
        text
        + f"""\
Next:
  1. Copy {CA_FILE}, NAME.pem and NAME-key.pem to the relay of that name, into a folder beside its relay.yaml:
       fabric: {{listen: [tls/0.0.0.0:7447], peers: [tls/OTHER:7447], relays: [{others}], certificates: FOLDER}}
     (that is of {first}; each relay names the others)
  2. Keep {CA_KEY_FILE} away from all relays: whoever has it can be any of them.
  3. A relay that is added (--relay NAME) must be named in `relays` of the others, which are started again.
"""
    )
