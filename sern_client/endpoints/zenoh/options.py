"""What the `zenoh` endpoint is told."""

from dataclasses import dataclass, field
from pathlib import Path

from sern_client.endpoints.zenoh.session import SessionOptions


@dataclass(frozen=True, slots=True)
class ZenohOptions:
    """`domain` is ROS_DOMAIN_ID, `node_name` how we appear in `ros2 node list`."""

    session: SessionOptions = field(default_factory=SessionOptions)
    domain: int = 0
    node_name: str = "sern"
    type_paths: tuple[Path, ...] = ()
