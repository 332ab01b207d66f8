"""The SDK's server: what it tells in threads of its own is told on the event loop here.

It speaks of topics, services and what viewers publish. What is shown of topics goes past it, to the viewers themselves.
"""

import asyncio
import logging
import secrets
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from sern_client.endpoints.common.handover import Handover
from sern_client.endpoints.foxglove.definitions import Described
from sern_core.vocabulary.errors import ConfigError
from sern_runtime.ros_types import one_line

if TYPE_CHECKING:
    import foxglove
    from foxglove import websocket

BACKLOG: Final = 16_384
"""What the SDK keeps for one viewer, by number. The door takes it at once, so that nothing gathers there. With fewer
the SDK cuts a viewer to whom some thousand topics are announced at once."""
HANDED_OVER_BYTES: Final = 16 * 2**20
"""What viewers publish and waits for the event loop."""


class Listener(Protocol):
    """Is told on the event loop. Clients and their channels by the SDK's numbers."""

    def looks(self, client: int, channel: int, *, looks: bool) -> None:
        """A viewer looks at a channel, or does not any more."""

    def advertised(self, client: int, channel: "Advertised") -> None:
        """A viewer is going to publish."""

    def unadvertised(self, client: int, channel: int) -> None: ...

    def published(self, client: int, channel: int, body: bytes) -> None: ...


class Advertised(NamedTuple):
    """What a viewer says of what it publishes."""

    number: int
    topic: str
    encoding: str
    type_name: str
    definition: str


class Server:
    """`start` once, `stop` once, both in the same event loop."""

    def __init__(self) -> None:
        self.address = ("", 0)
        """The place that it listens at, which only the door is told."""
        self._server: websocket.WebSocketServer | None = None
        self._context: foxglove.Context | None = None
        self._handover: Handover | None = None

    @property
    def dropped(self) -> int:
        """Messages of viewers, because the event loop was behind."""
        return 0 if self._handover is None else self._handover.dropped

    def start(self, listener: Listener, *, publishes: bool, encodings: Sequence[str]) -> None:
        """ConfigError when it does not start."""
        import foxglove
        from foxglove.websocket import Capability

        # It says who connects, and whatever is wrong with what they send: the door counts that, and says it once.
        logging.getLogger(foxglove.__name__).setLevel(logging.CRITICAL)
        self._handover = Handover(asyncio.get_running_loop(), max_bytes=HANDED_OVER_BYTES)
        self._context = foxglove.Context()
        capabilities = [Capability.Services, *([Capability.ClientPublish] if publishes else [])]
        host = f"127.{1 + secrets.randbelow(254)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
        try:
            self._server = foxglove.start_server(
                name="SERN",
                host=host,
                port=0,
                capabilities=capabilities,
                server_listener=_Listening(self._handover, listener),
                supported_encodings=list(encodings),
                context=self._context,
                session_id=secrets.token_hex(8),
                message_backlog_size=BACKLOG,
            )
        except RuntimeError as error:
            raise ConfigError(f"the server for viewers does not start: {one_line(error)}") from None
        self.address = (host, self._server.port)

    def stop(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            server.stop()
        if self._handover is not None:
            self._handover.close()

    def channel(
        self, topic: str, message_encoding: str, described: Described, ended: Callable[[int], None]
    ) -> "Channel":
        """A new channel; its number is told to `ended` when it is closed. The constructor that the SDK has for it keeps
        each one for ever."""
        import foxglove

        assert self._context is not None
        schema = foxglove.Schema(name=described.name, encoding=described.schema_encoding, data=described.text)
        return Channel(self._context._create_channel(topic, message_encoding=message_encoding, schema=schema), ended)

    def add_service(self, service: "foxglove.Service") -> None:
        """ConfigError when it is not taken."""
        assert self._server is not None
        try:
            self._server.add_services([service])
        except RuntimeError as error:
            raise ConfigError(f"{service.name}: viewers cannot be served: {one_line(error)}") from None

    def remove_service(self, name: str) -> None:
        if self._server is not None:
            self._server.remove_services([name])


class Channel:
    """A topic as viewers are told of it."""

    def __init__(self, base: "foxglove._foxglove_py.BaseChannel", ended: Callable[[int], None]) -> None:
        self.number: int = base.id()
        self._close = base.close
        self._ended = ended

    def close(self) -> None:
        self._close()
        self._ended(self.number)


class _Listening:
    """The SDK's `ServerListener`, in its threads."""

    def __init__(self, handover: Handover, listener: Listener) -> None:
        self._handover = handover
        self._listener = listener

    def on_subscribe(self, client: "websocket.Client", channel: "websocket.ChannelView") -> None:
        self._looks(client.id, channel.id, looks=True)

    def on_unsubscribe(self, client: "websocket.Client", channel: "websocket.ChannelView") -> None:
        self._looks(client.id, channel.id, looks=False)

    def _looks(self, client: int, channel: int, *, looks: bool) -> None:
        self._handover.news(lambda: self._listener.looks(client, channel, looks=looks))

    def on_client_advertise(self, client: "websocket.Client", channel: "websocket.ClientChannel") -> None:
        number = client.id
        definition = "" if channel.schema is None else channel.schema.decode(errors="replace")
        said = Advertised(channel.id, channel.topic, channel.encoding, channel.schema_name, definition)
        self._handover.news(lambda: self._listener.advertised(number, said))

    def on_client_unadvertise(self, client: "websocket.Client", client_channel_id: int) -> None:
        number = client.id
        self._handover.news(lambda: self._listener.unadvertised(number, client_channel_id))

    def on_message_data(self, client: "websocket.Client", client_channel_id: int, data: bytes) -> None:
        number = client.id
        self._handover.put(lambda: self._listener.published(number, client_channel_id, data), len(data))

    def on_get_parameters(
        self, client: "websocket.Client", param_names: list[str], request_id: str | None = None
    ) -> "list[foxglove.Parameter]":
        """There are none, and the server does not offer any."""
        return []

    def on_set_parameters(
        self, client: "websocket.Client", parameters: "list[foxglove.Parameter]", request_id: str | None = None
    ) -> "list[foxglove.Parameter]":
        return []

    def on_parameters_subscribe(self, param_names: list[str]) -> None:
        """Nothing to do, as in all that is about parameters and the graph."""

    def on_parameters_unsubscribe(self, param_names: list[str]) -> None: ...

    def on_connection_graph_subscribe(self) -> None: ...

    def on_connection_graph_unsubscribe(self) -> None: ...

    def on_playback_control_request(
        self, playback_control_request: "websocket.PlaybackControlRequest"
    ) -> "websocket.PlaybackState | None":
        """What is live is not played back."""
        return None
