"""The latest small value of each topic that passes a client, for whoever looks at it (`sern echo`)."""

import base64
from collections.abc import Mapping
from typing import Any, Final

from sern_core.objects.registry import topic_object_id
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import StreamId, StreamInfo
from sern_core.wire.announce import definition_hash
from sern_runtime.http_routes import JsonQuery

MAX_VALUE_BYTES: Final = 4_096
"""Only the size is known of a larger value, as in the relay's registry."""
MAX_TOPICS: Final = 4_096
"""The stream that was seen first is forgotten beyond this number."""


class LatestValues:
    """`passed` for each message; what is kept is at most `MAX_TOPICS * MAX_VALUE_BYTES`."""

    def __init__(self) -> None:
        self._values: dict[StreamId, tuple[StreamInfo, int, int, bytes | None]] = {}

    def passed(self, stream: StreamInfo, seq: int, body: bytes) -> None:
        """A message of `stream` went by, in either direction."""
        size = len(body)
        if len(self._values) >= MAX_TOPICS and stream.id not in self._values:
            del self._values[next(iter(self._values))]
        self._values[stream.id] = stream, seq, size, body if size <= MAX_VALUE_BYTES else None

    def forget(self, stream: StreamId) -> None:
        """The stream has ended."""
        self._values.pop(stream, None)

    def view(self) -> JsonQuery:
        """The route `/api/values?topic=NAME`: objects as in the relay's /api/objects.

        One topic at a time: an answer with all of them would hold up the event loop.
        """

        def read(query: Mapping[str, str]) -> object:
            if "topic" not in query:
                raise UsageError("topic is missing: /api/values?topic=NAME")
            found = [value for key, value in self._values.items() if key.topic == query["topic"]]
            texts = (stream.info.definition for stream, *_ in found)
            return {
                "objects": [_to_json(*value) for value in found],
                "definitions": {definition_hash(text): text for text in texts if text},
            }

        return JsonQuery(("topic",), read)


def _to_json(stream: StreamInfo, seq: int, size: int, body: bytes | None) -> dict[str, Any]:
    info = stream.info
    value: dict[str, Any] = {"bytes": size}
    if body is not None:
        value["base64"] = base64.b64encode(body).decode("ascii")
    return {
        "id": topic_object_id(stream.id),
        "owner": stream.id.origin,
        "type": info.type_name,
        "definition_key": definition_hash(info.definition),
        "attributes": {"topic": stream.id.topic, "encoding": info.encoding.value},
        "seq": seq,
        "version": seq,
        "value": value,
    }
