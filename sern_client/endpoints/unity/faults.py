"""What is wrong with what scenes say and ask for: counted, told to the scene in question, and one line in the log."""

import logging
from collections import Counter
from enum import StrEnum
from typing import Protocol

from sern_client.endpoints.common.saying import SayOnce


class Fault(StrEnum):
    """Closed: it is a metric label."""

    FRAMING = "framing"  # bytes that are no frame; the connection ends
    COMMAND = "command"  # a command that is unknown, no JSON, or of other fields
    NAME = "name"  # no name of a topic or service, or no name of a type
    UNKNOWN_TYPE = "unknown_type"  # nothing here knows the type
    OTHER_TYPE = "other_type"  # the topic or service is of another type
    NOT_ALLOWED = "not_allowed"  # `publish` of the endpoint does not name the topic
    NOT_REGISTERED = "not_registered"  # a message for a topic or service that the scene has not registered
    BODY = "body"  # no body of this protocol
    TOO_LARGE = "too_large"  # a message above `max_message_bytes`
    TOO_MANY = "too_many"  # scenes, subscriptions, publications, services or calls
    CALL = "call"  # a call that failed, or an answer to none
    STALLED = "stalled"  # it did not read; the connection ends


class Told(Protocol):
    """A scene, to whom texts can be shown."""

    def error(self, text: str) -> None:
        """Show a text as an error; the same one once."""

    def warn(self, text: str) -> None:
        """The same for what is no error."""


class Faults:
    """Those of one endpoint."""

    def __init__(self, log: logging.Logger) -> None:
        self.counts: Counter[Fault] = Counter()
        self._say_once = SayOnce(log)

    def __call__(self, fault: Fault, text: str, scene: Told | None) -> None:
        """Something is wrong. `scene` None: it hears nothing any more."""
        self.counts[fault] += 1
        self._say_once(lambda: f"a scene: {text}", fault, text)
        if scene is not None:
            scene.error(text)
