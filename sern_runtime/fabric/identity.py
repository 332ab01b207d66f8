"""Who a relay is by its certificate, where TLS does not end at the other relay: what it signs, and whom it believes."""

from collections.abc import Sequence
from typing import Final, Self

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.x509.oid import NameOID

from sern_core.vocabulary.errors import ConfigError, SernError
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.fabric import CertificateFiles, issuer

CERTIFICATE_BYTES: Final = 4096
"""The largest certificate (DER) that is looked at; those of `sern keygen fabric` have less than 600."""
SIGNATURE_BYTES: Final = 160
"""The largest signature: ECDSA on P-521 has 139 bytes in DER."""
_ALGORITHM: Final = ec.ECDSA(SHA256())


class StrangerError(SernError):
    """A certificate or a signature that does not show what it is to show. One line."""


class Identity:
    """This relay's certificate and key, and the authorities that it believes. `certificate`: in DER."""

    def __init__(
        self, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey, authorities: Sequence[x509.Certificate]
    ) -> None:
        self.certificate = certificate.public_bytes(serialization.Encoding.DER)
        self._key = key
        self._authorities = tuple(authorities)

    @classmethod
    def read(cls, files: CertificateFiles) -> Self:
        """Raises ConfigError that names the file."""
        path = files.ca
        try:
            authorities = x509.load_pem_x509_certificates(path.read_bytes())
            path = files.certificate
            certificate = x509.load_pem_x509_certificate(path.read_bytes())
            path = files.key
            key = serialization.load_pem_private_key(path.read_bytes(), password=None)
        except OSError as error:
            raise ConfigError(f"can not be read: {error.strerror or error}", file=str(path)) from error
        except (ValueError, TypeError, UnsupportedAlgorithm) as error:
            raise ConfigError(
                "is no certificate or key in PEM; sern keygen fabric makes them", file=str(path)
            ) from error
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            problem = "is no key of ECDSA, which datagrams through external routers need; sern keygen fabric makes them"
            raise ConfigError(problem, file=str(path))
        return cls(certificate, key, authorities)

    def sign(self, data: bytes) -> bytes:
        return self._key.sign(data, _ALGORITHM)

    def verify(self, certificate: bytes, name: ClientName, data: bytes, signature: bytes, *, at_s: float) -> float:
        """When the certificate expires (seconds since 1970). It is that of the relay of this name, valid at `at_s`, by
        an authority that is valid, too, and `signature` over `data` is by its key; else raises StrangerError."""
        if len(certificate) > CERTIFICATE_BYTES or len(signature) > SIGNATURE_BYTES:
            raise StrangerError("its certificate or signature is too large")
        try:
            shown = x509.load_der_x509_certificate(certificate)
            names = [str(each.value) for each in shown.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
            if names != [name]:
                raise StrangerError(f"its certificate is of {', '.join(names)[:80] or 'nobody'}")
            authority = issuer(shown, self._authorities)
            if authority is None:
                raise StrangerError("its certificate was not signed by the authority in ca.pem")
            expires_s = min(_valid_until_s(each, at_s) for each in (shown, authority))
            key = shown.public_key()
            if not isinstance(key, ec.EllipticCurvePublicKey):
                raise StrangerError("the key of its certificate is none of ECDSA")
            key.verify(signature, data, _ALGORITHM)
        except InvalidSignature:
            raise StrangerError("its signature is not by the key of its certificate") from None
        except (ValueError, TypeError, UnsupportedAlgorithm, x509.InvalidVersion):
            raise StrangerError("its certificate can not be read") from None
        return expires_s


def _valid_until_s(certificate: x509.Certificate, at_s: float) -> float:
    until_s = certificate.not_valid_after_utc.timestamp()
    if not certificate.not_valid_before_utc.timestamp() <= at_s < until_s:
        raise StrangerError("its certificate, or that of its authority, is not valid now")
    return until_s
