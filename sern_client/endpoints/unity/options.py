"""What a unity endpoint is told by its file; `sern_runtime/config/unity.py` says what each means."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True, slots=True)
class UnityOptions:
    """The options of the endpoint. With `second` it listens nowhere: another process of the client has the port."""

    listen: str = "127.0.0.1:10000"
    protocol: Literal["ros1", "ros2"] = "ros2"
    allow_remote: bool = False
    publish: tuple[str, ...] = ()
    max_connections: int = 10
    max_message_bytes: int = 64 * 2**20
    queue_bytes: int = 64 * 2**20
    stalled_s: float = 10.0
    type_paths: tuple[Path, ...] = ()
    second: bool = False

    @property
    def place(self) -> tuple[str, int]:
        """Host, without the brackets of IPv6, and port."""
        host, _, port = self.listen.rpartition(":")
        return host.strip("[]"), int(port)
