"""The section of an endpoint of kind `unity`: where scenes connect, and what they may do."""

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
    fault,
    is_local,
    missing_directories,
    pattern_problems,
)
from sern_runtime.config.viewing import Publishable
from sern_runtime.config.yaml import Loc


class UnityEndpoint(EndpointBase):
    """Unity scenes with ROS-TCP-Connector: they connect to this client as to a ROS-TCP-Endpoint, and need no ROS."""

    kind: Literal["unity"]
    """Unity scenes connect here."""
    listen: HttpListen = "127.0.0.1:10000"
    """`address:port` to listen on. The protocol has neither keys nor encryption: elsewhere than on loopback it takes
    `allow_remote`."""
    allow_remote: bool = False
    """Listen elsewhere than on loopback: whoever reaches the port sees and says what a scene may."""
    protocol: Literal["ros1", "ros2"] = "ros2"
    """As the scene has it under Robotics, ROS Settings, Protocol. Messages of the other ROS are converted."""
    publish: Publishable = False
    """What scenes may publish: true: any topic, or patterns of names. By default nothing: who looks does not drive."""
    type_paths: tuple[PathText, ...] = ()
    """Directories with .msg and .srv files (searched at any depth), for types of scenes that are neither in a ROS 2
    installation of this machine nor of Jazzy's desktop."""
    max_connections: Annotated[int, Field(ge=1, le=100)] = 8
    """Scenes at a time."""
    max_message_bytes: Annotated[int, Field(ge=1000, le=1 << 30)] = 64 * 2**20
    """A scene that sends a longer message is disconnected."""
    max_waiting_bytes: Bytes = 8 * 2**20
    """What may wait for one scene; beyond, its oldest messages are dropped and counted. Of a topic that is best effort
    the newest message alone waits."""
    stalled_s: Annotated[float, Field(ge=1, le=600)] = 10.0
    """A scene that takes nothing for so long is disconnected."""

    @model_validator(mode="after")
    def _stays_here(self) -> "UnityEndpoint":
        if not self.allow_remote and not is_local(f"tcp://{self.listen}"):
            raise fault(
                f"{self.listen} is open to the network, and the protocol has neither keys nor encryption: listen on "
                "127.0.0.1 and come through an SSH tunnel (ssh -L 10000:127.0.0.1:10000), or set allow_remote: true",
                "listen",
            )
        return self

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        yield from missing_directories(base_dir, self.type_paths, (*loc, "type_paths"))
        if not isinstance(self.publish, bool):
            yield from pattern_problems(self.publish, (*loc, "publish"))
