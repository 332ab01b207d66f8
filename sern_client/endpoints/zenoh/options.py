"""What the `zenoh` endpoint is told."""

from dataclasses import dataclass, field
from pathlib import Path

from sern_client.endpoints.zenoh.names import ENCLAVE
from sern_client.endpoints.zenoh.session import SessionOptions


@dataclass(frozen=True, slots=True)
class ZenohOptions:
    """`domain` is ROS_DOMAIN_ID, `node_name` how we appear in `ros2 node list`. `accept_bridged`: what other SERN
    endpoints publish and serve counts as of this site. In another `enclave` than ours it is a node as others have."""

    session: SessionOptions = field(default_factory=SessionOptions)
    domain: int = 0
    node_name: str = "sern"
    type_paths: tuple[Path, ...] = ()
    accept_bridged: bool = False
    enclave: str = ENCLAVE
