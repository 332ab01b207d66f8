"""The section of an endpoint of kind `unity`: where scenes of Unity connect to."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sern_runtime.config.base import (
    Bytes,
    EndpointBase,
    FileProblem,
    HttpListen,
    PathText,
    Pattern,
    fault,
    is_local,
    missing_directories,
    pattern_problems,
)
from sern_runtime.config.yaml import Loc


class UnityEndpoint(EndpointBase):
    """Scenes of Unity with Unity's package ROS-TCP-Connector, which connect to this client as to a ROS-TCP-Endpoint. It
    needs no ROS and no further package."""

    kind: Literal["unity"]
    """Scenes of Unity."""
    listen: HttpListen = "127.0.0.1:10000"
    """`address:port` that scenes connect to."""
    protocol: Literal["ros1", "ros2"] = "ros2"
    """What scenes are compiled for (Robotics, ROS Settings, Protocol): `ros1` or `ros2`. What robots send is converted
    to it."""
    allow_remote: bool = False
    """Listen on an address that others reach. The protocol has neither keys nor encryption: whoever reaches it sees
    everything and publishes what `publish` names. An SSH tunnel or WireGuard is better."""
    publish: tuple[Pattern, ...] = ()
    """Topics (local names) that a scene may publish. None unless named here: nobody who connects has shown who they
    are, and what they publish may move a robot."""
    max_connections: Annotated[int, Field(ge=1, le=1000)] = 10
    """Scenes at once; one more is told so and sent away."""
    max_message_bytes: Annotated[int, Field(ge=1000, le=1 << 30)] = 64 * 2**20
    """Longer messages of scenes are dropped and counted."""
    queue_bytes: Bytes = 64 * 2**20
    """Bytes that may wait for one slow scene; at least one message always may. Of a best-effort topic only the newest
    message waits."""
    stalled_s: Annotated[float, Field(ge=0.1, le=3600)] = 10.0
    """A scene that reads nothing for so long, while something waits for it, is disconnected; it may come back."""
    type_paths: tuple[PathText, ...] = ()
    """Directories with .msg and .srv files (searched at any depth), for types of scenes that are neither in a ROS 2
    installation of this machine nor of Jazzy's (`ros1`: Noetic's) desktop."""

    @model_validator(mode="after")
    def _is_for_this_machine(self) -> "UnityEndpoint":
        if not self.allow_remote and not is_local(f"tcp://{self.listen}"):
            raise fault(
                f"{self.listen} is open to the network, and the protocol has neither keys nor encryption; listen on "
                "127.0.0.1 and come through an SSH tunnel (ssh -L) or WireGuard, or set allow_remote: true",
                "listen",
            )
        return self

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        yield from missing_directories(base_dir, self.type_paths, (*loc, "type_paths"))
        yield from pattern_problems(self.publish, (*loc, "publish"))
