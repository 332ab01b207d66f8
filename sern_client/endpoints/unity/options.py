"""The options of the endpoint."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sern_core.vocabulary.types import Encoding


@dataclass(frozen=True, slots=True)
class UnityOptions:
    """Each as the key of its name in the configuration file."""

    listen: str = "127.0.0.1:10000"
    allow_remote: bool = False
    protocol: Literal["ros1", "ros2"] = "ros2"
    publish: bool | tuple[str, ...] = False
    type_paths: tuple[Path, ...] = ()
    max_connections: int = 8
    max_message_bytes: int = 64 * 2**20
    max_waiting_bytes: int = 8 * 2**20
    stalled_s: float = 10.0

    @property
    def encoding(self) -> Encoding:
        return Encoding.CDR if self.protocol == "ros2" else Encoding.ROS1
