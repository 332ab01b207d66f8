"""What both directions between an endpoint and the core share: the endpoint, and how things there are called."""

from collections.abc import Callable
from typing import Final

from sern_client.endpoints.base import Endpoint, Publisher
from sern_client.endpoints.conversion import Converter, HasConverter
from sern_client.frames import FramePrefixer
from sern_client.latest import LatestValues
from sern_core.topics.rules import RuleSet
from sern_core.vocabulary.message import TopicInfo
from sern_runtime.events import EventLog
from sern_runtime.message_log import MessageLog
from sern_runtime.optional import OptionalParts

CAPPED: Final = "max_rate_hz"
"""The attribute of a stream that its origin thins to a rate, as text: with it whoever looks at the topic is told."""


class Site:
    """One client's own side. `kick` is called when the core may have something to send."""

    def __init__(
        self,
        endpoint: Endpoint,
        rules: RuleSet,
        namespace: str,
        *,
        kick: Callable[[], None],
        frame_prefix: str | None = None,
        log: MessageLog | None = None,
        parts: OptionalParts | None = None,
        events: EventLog | None = None,
    ) -> None:
        self.endpoint = endpoint
        self.rules = rules
        self.namespace = namespace
        self.kick = kick
        self.log = log
        self.parts = parts or OptionalParts()
        self.events = events or EventLog()
        self.frames = FramePrefixer(frame_prefix)
        self.converter = endpoint.converter if isinstance(endpoint, HasConverter) else Converter()
        self.values = LatestValues()

    def advertise(self, info: TopicInfo) -> Publisher:
        """Publish a topic at the endpoint, converted where it takes the other encoding. Raises ConfigError."""
        return self.converter.advertise(self.endpoint, info)
