"""What an `rclpy` endpoint is told."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class RclpyOptions:
    """`domain` None: ROS_DOMAIN_ID of the environment. `poll_hz`: how often the graph is asked what there is.
    `services_only`: topics are another endpoint's, in the same client. `max_buffer_bytes`: what may wait for the event
    loop. `as_node`: for SERN endpoints it is a node as others have, whose topics are of this site."""

    node_name: str = "sern"
    domain: int | None = None
    poll_hz: float = 4.0
    services_only: bool = False
    type_paths: tuple[Path, ...] = ()
    max_buffer_bytes: int = 64 * 2**20
    accept_bridged: bool = False
    as_node: bool = False
