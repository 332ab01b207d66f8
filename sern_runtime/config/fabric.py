"""Section `fabric` of a relay's file: where other relays are, and by which names and certificates they are known.

Nothing of zenoh is imported here.
"""

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import Field, model_validator

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.base import (
    ClientText,
    FileProblem,
    PathText,
    Section,
    check_address,
    checked,
    described,
    fault,
    is_local,
    resolve,
)
from sern_runtime.config.keys import secret_warning
from sern_runtime.config.yaml import Loc

if TYPE_CHECKING:
    from cryptography import x509

CA_NAME: Final = "ca"
CA_FILE: Final = f"{CA_NAME}.pem"
EXPIRES_SOON_S: Final = 30 * 86_400.0
LEASE_S: Final = 2.0
_LOCATOR: Final = re.compile(r"(tcp|tls)/(.+)")


def certificate_file(relay: str) -> str:
    """The name of its certificate in a folder, as `sern keygen fabric` has it."""
    return f"{relay}.pem"


def key_file(relay: str) -> str:
    """The name of the key of that certificate."""
    return f"{relay}-key.pem"


def _parts(locator: str) -> tuple[str, str]:
    """Protocol and `host:port`. UsageError for what is no locator of ours."""
    match = _LOCATOR.fullmatch(locator)
    if match is None:
        raise UsageError(f"{locator[:80]!r} is not an address; accepted: tls/host:port, tcp/host:port")
    return match[1], match[2]


def _check_connect(locator: str) -> None:
    check_address(_parts(locator)[1], bind=False)


def _check_listen(locator: str) -> None:
    check_address(_parts(locator)[1], bind=True)


ConnectLocator = Annotated[str, checked(_check_connect)]
ListenLocator = Annotated[str, checked(_check_listen)]


@dataclass(frozen=True, slots=True)
class CertificateFiles:
    """The files by which a relay shows who it is, and knows others."""

    ca: Path
    certificate: Path
    key: Path


class CertificatesSection(Section):
    """The certificates one by one, where they are not in one folder as `sern keygen fabric` makes them."""

    ca: PathText
    """The certificate of the authority that signed those of all relays."""
    certificate: PathText
    """This relay's certificate; its common name must be the relay's name."""
    key: PathText
    """The key of that certificate; secret."""


class FabricSection(Section):
    """Other relays that this one forms a fabric with (docs/fabric.md). Needs the extra `zenoh`. Every two relays need a
    connection, which either may make."""

    listen: Annotated[tuple[ListenLocator, ...], Field(max_length=16)] = ()
    """Where other relays connect: tls/address:port, or tcp/address:port on loopback; `*` is every address."""
    peers: Annotated[tuple[ConnectLocator, ...], Field(max_length=256)] = ()
    """Where to connect: tls/host:port of other relays, of external routers with `external: true`. Those that are not
    there are tried again for ever."""
    relays: Annotated[tuple[ClientText, ...], Field(max_length=256)] | None = None
    """The names of the other relays, by which their certificates are known; nobody else takes part. Needed with
    `certificates`; null: whoever reaches an address of this machine takes part."""
    certificates: Annotated[
        PathText | CertificatesSection | None, described("a folder, or a mapping of ca, certificate and key")
    ] = None
    """The folder with ca.pem, NAME.pem and NAME-key.pem of `sern keygen fabric`, NAME being this relay's, or a mapping
    of `ca`, `certificate` and `key`. Needed beyond loopback."""
    external: bool = False
    """Be a client of zenoh routers of your own, in place of connections between the relays. With `certificates`, what
    goes between two relays is sealed, and the routers need not be believed (docs/fabric.md)."""
    lease_s: Annotated[float, Field(ge=0.5, le=60)] = LEASE_S
    """A relay of which nothing is heard for so long is gone."""

    @model_validator(mode="after")
    def _consistent(self) -> "FabricSection":
        if not self.listen and not self.peers:
            raise fault("has neither listen nor peers: nobody could be reached; name an address in one of them")
        if self.external and self.listen:
            raise fault("has no use with external: true: a client of routers listens nowhere; remove it", "listen", 0)
        if self.external and not self.peers:
            raise fault("is missing: external: true needs the routers' addresses", "peers")
        for key in ("listen", "peers"):
            locators: tuple[str, ...] = getattr(self, key)
            for index, locator in enumerate(locators):
                if locator in locators[:index]:
                    raise fault("names an address twice", key, index)
                self._check_protection(locator, key, index)
        if self.relays is not None and len(set(self.relays)) != len(self.relays):
            raise fault("names a relay twice", "relays")
        if self.certificates is not None and self.relays is None and not self.external:
            raise fault("is missing: with certificates, name the relays that may take part", "relays")
        return self

    def _check_protection(self, locator: str, key: str, index: int) -> None:
        protocol, address = _parts(locator)
        if protocol == "tls":
            if self.certificates is None:
                problem = f"{locator} needs certificates: make them with sern keygen fabric, and name their folder"
                raise fault(f"{problem} in fabric.certificates", key, index)
        elif not is_local(f"tcp://{address}"):
            problem = f"{locator} is open to the network, and tcp is neither encrypted nor checked"
            raise fault(f"{problem}; write tls/{address} and name fabric.certificates", key, index)
        elif self.certificates is not None:
            problem = f"{locator} would bypass the certificates; write tls/{address}, or remove fabric.certificates"
            raise fault(problem, key, index)

    def certificate_files(self, base_dir: Path, relay: str) -> CertificateFiles | None:
        """Where the certificates of this relay are; None: it has none."""
        if self.certificates is None:
            return None
        if isinstance(self.certificates, CertificatesSection):
            ca, certificate, key = (
                resolve(base_dir, text)
                for text in (self.certificates.ca, self.certificates.certificate, self.certificates.key)
            )
            return CertificateFiles(ca, certificate, key)
        folder = resolve(base_dir, self.certificates)
        return CertificateFiles(folder / CA_FILE, folder / certificate_file(relay), folder / key_file(relay))

    @property
    def others(self) -> tuple[ClientName, ...] | None:
        """The other relays' names."""
        return None if self.relays is None else tuple(ClientName(name) for name in self.relays)

    def problems(self, base_dir: Path, relay: str) -> Iterator[FileProblem]:
        """Problems of the section as that of this relay, and of the files that it names."""
        from sern_runtime.config.endpoints import installing, missing_package

        yield from missing_package("zenoh", installing("eclipse-zenoh"), (), "fabric")
        if self.relays is not None and relay in self.relays:
            at = ("fabric", "relays", self.relays.index(relay))
            yield FileProblem(at, f"{relay} is this relay itself; name the others")
        files = self.certificate_files(base_dir, relay)
        if files is not None:
            yield from certificate_problems(files, ("fabric", "certificates"), relay)


def issuer(certificate: "x509.Certificate", authorities: "Sequence[x509.Certificate]") -> "x509.Certificate | None":
    """Which of them has signed it; while the authority is replaced ca.pem holds two."""
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm

    for authority in authorities:
        try:
            certificate.verify_directly_issued_by(authority)
        except (InvalidSignature, UnsupportedAlgorithm, ValueError, TypeError):
            continue
        return authority
    return None


def certificate_problems(
    files: CertificateFiles, loc: Loc, relay: str, *, at_s: float | None = None
) -> Iterator[FileProblem]:
    """Problems of the files of that relay at a time (seconds since 1970; None: now)."""
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization
    from cryptography.x509.oid import NameOID

    at_s = time.time() if at_s is None else at_s
    contents: dict[Path, bytes] = {}
    for path in (files.ca, files.certificate, files.key):
        try:
            contents[path] = path.read_bytes()
        except OSError as error:
            hint = "sern keygen fabric makes them"
            yield FileProblem(loc, f"{path}: can not be read ({error.strerror or error}); {hint}")
    if len(contents) < 3:
        return
    try:
        path = files.ca
        authorities = x509.load_pem_x509_certificates(contents[path])
        path = files.certificate
        mine = x509.load_pem_x509_certificate(contents[path])
    except ValueError:
        yield FileProblem(loc, f"{path}: is no certificate in PEM")
        return
    try:
        key = serialization.load_pem_private_key(contents[files.key], password=None)
    except (ValueError, TypeError):
        yield FileProblem(loc, f"{files.key}: is no key in PEM without a password")
        return
    if key.public_key() != mine.public_key():
        yield FileProblem(loc, f"{files.key} is not the key of {files.certificate}")
    names = [str(name.value) for name in mine.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    if names != [relay]:
        shown = ", ".join(names) or "nobody"
        yield FileProblem(loc, f"{files.certificate} is of {shown}, and this is {relay}; use that of {relay}")
    authority = issuer(mine, authorities)
    if authority is None:
        yield FileProblem(loc, f"{files.certificate} was not signed by {files.ca}; use those of one authority")
    for path, certificate in ((files.ca, authority or authorities[0]), (files.certificate, mine)):
        left_s = certificate.not_valid_after_utc.timestamp() - at_s
        if left_s <= 0:
            yield FileProblem(loc, f"{path} has expired on {certificate.not_valid_after_utc:%Y-%m-%d}; make new ones")
        elif certificate.not_valid_before_utc.timestamp() > at_s:
            yield FileProblem(loc, f"{path} is not valid before {certificate.not_valid_before_utc:%Y-%m-%d}")
        elif left_s < EXPIRES_SOON_S:
            problem = f"{path} expires on {certificate.not_valid_after_utc:%Y-%m-%d}; make new ones before"
            yield FileProblem(loc, problem, warning=True)
    warning = secret_warning(files.key)
    if warning is not None:
        yield FileProblem(loc, warning, warning=True)
