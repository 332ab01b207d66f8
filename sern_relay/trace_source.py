"""What a relay knows of the streams of one topic, for /api/trace."""

from collections.abc import Iterator

from sern_core.relay.hub import Hub
from sern_core.vocabulary.types import TopicName
from sern_runtime.trace_view import Seen, Source


def of_hub(hub: Hub) -> Source:
    """A relay has a link for each client: a stream comes over one of them, and goes out over others."""

    def streams(topic: TopicName) -> Iterator[Seen]:
        for identity, relayed in hub.relayed.items():
            if identity.topic != topic:
                continue
            if relayed.source is not None:
                yield Seen(relayed.source, relayed.stream.stream, goes_out=False)
            for link, channel in relayed.outs.values():
                yield Seen(link, channel.stream, goes_out=True)

    return Source(
        lambda: {str(name): trace for name, trace in hub.traces.by_client().items()},
        lambda: (identity.topic for identity in hub.relayed),
        streams,
    )
