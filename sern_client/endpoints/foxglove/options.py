"""The options of the endpoint."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True, slots=True)
class FoxgloveOptions:
    """Each as the key of its name in the configuration file."""

    listen: str = "127.0.0.1:8765"
    tls_certificate: Path | None = None
    tls_key: Path | None = None
    token: str | None = None
    origins: tuple[str, ...] = ("https://app.foxglove.dev",)
    publish: bool | tuple[str, ...] = False
    encoding: Literal["ros1", "cdr"] = "cdr"
    max_waiting_bytes: int = 8 * 2**20
