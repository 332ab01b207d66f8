"""The section of an endpoint of kind `foxglove`: where Foxglove and Lichtblick connect, and what they may do."""

import importlib.util
import ssl
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, model_validator

from sern_runtime.config.base import (
    EndpointBase,
    FileProblem,
    HttpListen,
    PathText,
    fault,
    is_local,
    pattern_problems,
    resolve,
)
from sern_runtime.config.viewing import Publishable
from sern_runtime.config.yaml import Loc

PACKAGE: Final = "foxglove"
MIN_TOKEN: Final = 16
FOXGLOVE_ORIGIN: Final = "https://app.foxglove.dev"


def installing_foxglove() -> str:
    """The command that installs what the endpoint needs, where SERN is."""
    return f"{sys.executable} -m pip install foxglove-sdk"


def _check_token(text: str) -> str:
    if len(text) < MIN_TOKEN or not all(char.isalnum() or char in "-_.~" for char in text) or not text.isascii():
        raise fault(
            f"must be {MIN_TOKEN} or more of A-Z, a-z, 0-9, '-', '_', '.', '~', such as openssl rand -hex 16 gives"
        )
    return text


def _check_origin(text: str) -> str:
    scheme, separator, host = text.partition("://")
    if not separator or not scheme.isalpha() or not host or any(char in host for char in "/?#*@ "):
        raise fault("must be the address of a site without a path, such as https://lichtblick.example")
    return text.lower()


class FoxgloveEndpoint(EndpointBase):
    """Foxglove and Lichtblick, or whatever speaks the Foxglove WebSocket protocol: they connect to this client and look
    at topics of other sites. Needs the extra `foxglove` (`'.[foxglove]'` where SERN is installed)."""

    kind: Literal["foxglove"]
    """Foxglove and Lichtblick connect here."""
    listen: HttpListen = "127.0.0.1:8765"
    """`address:port` to listen on. Elsewhere than on loopback `tls_certificate`, `tls_key` and `token` are needed."""
    tls_certificate: PathText | None = None
    """The certificate of this server (PEM, with those between it and the authority); null: no TLS."""
    tls_key: PathText | None = None
    """The private key of that certificate (PEM, not encrypted)."""
    token: Annotated[str, AfterValidator(_check_token)] | None = None
    """What a viewer must have in its address: ws://127.0.0.1:8765/?token=TOKEN. null: whoever reaches the port may
    look. With one, keep this file to yourself (chmod 600)."""
    origins: Annotated[tuple[Annotated[str, AfterValidator(_check_origin)], ...], Field(max_length=100)] = (
        FOXGLOVE_ORIGIN,
    )
    """Web pages that may connect without a token, by scheme, host and port; beside them desktop applications, programs,
    and pages of this machine's loopback. Any other page that is open in a browser here is refused."""
    publish: Publishable = False
    """What viewers may publish: true: any topic, or patterns of names. By default nothing: who looks does not drive."""
    encoding: Literal["ros1", "cdr"] = "cdr"
    """How messages are serialised that viewers send as JSON: `ros1` or `cdr` (ROS 2). The far side converts them."""
    max_waiting_bytes: Annotated[int, Field(ge=1 << 16, le=1 << 30)] = 8 * 2**20
    """What may wait for one viewer; beyond, its oldest messages are dropped and counted. At least one message may."""

    @model_validator(mode="after")
    def _fits_together(self) -> "FoxgloveEndpoint":
        if (self.tls_certificate is None) != (self.tls_key is None):
            missing = "tls_certificate" if self.tls_certificate is None else "tls_key"
            raise fault("certificate and key belong together: name both, or neither", missing)
        if not is_local(f"tcp://{self.listen}"):
            missing_keys = [key for key in ("tls_certificate", "tls_key", "token") if getattr(self, key) is None]
            if missing_keys:
                raise fault(
                    f"{self.listen} is open to the network: set {', '.join(missing_keys)}, or listen on 127.0.0.1 and "
                    "come through an SSH tunnel (ssh -L)",
                    "listen",
                )
        return self

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        if PACKAGE not in sys.modules and importlib.util.find_spec(PACKAGE) is None:
            problem = f"needs the Python package foxglove-sdk, which is not on this machine: {installing_foxglove()}"
            yield FileProblem((*loc, "kind"), problem, warning=True)
        if not isinstance(self.publish, bool):
            yield from pattern_problems(self.publish, (*loc, "publish"))
        if self.tls_certificate is None or self.tls_key is None:
            return
        missing = False
        for key, text in (("tls_certificate", self.tls_certificate), ("tls_key", self.tls_key)):
            if not resolve(base_dir, text).is_file():
                missing = True
                yield FileProblem((*loc, key), f"{resolve(base_dir, text)}: no such file")
        if not missing:
            yield from self._pair_problems(base_dir, loc)

    def _pair_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        assert self.tls_certificate is not None and self.tls_key is not None
        certificate, key = resolve(base_dir, self.tls_certificate), resolve(base_dir, self.tls_key)
        try:
            ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(certificate, key, password=_no_password)
        except (ssl.SSLError, OSError, ValueError) as error:
            yield FileProblem((*loc, "tls_certificate"), f"{certificate} and {key} cannot be used: {one_reason(error)}")


def _no_password() -> str:
    """A key that is encrypted is an error: nobody is asked while a daemon starts."""
    raise ValueError("the key is encrypted; openssl pkey -in KEY -out NEW writes one that is not")


def one_reason(error: Exception) -> str:
    """What is wrong with a certificate or a key, in a few words."""
    if isinstance(error, ssl.SSLError) and error.reason:
        return str(error.reason).replace("_", " ").lower()
    return str(getattr(error, "strerror", None) or error)
