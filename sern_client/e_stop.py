"""Emergency stops: a message latches one, and no command of other sites is obeyed until it is released by name.

The robot is stopped at once. What is latched is on disk before anybody is told of it, so that a restart of the client
changes nothing; a file that cannot be read counts as every stop latched. A release is a call of `release`, never a
message of the topic itself: a topic that says "not stopped" twice a second would end each stop at once.
"""

import json
import logging
import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sern_client.endpoints.base import Sink
from sern_core.topics.patterns import PatternSet
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime.events import EventLog, wall_text
from sern_runtime.whole_file import write_whole

RELEASE_SUFFIX: Final = "/release"
"""The topic of this name below an e-stop's: a message there, from whoever may publish the stop, releases it."""
MAX_FILE_BYTES: Final = 64 * 1024

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class EStop:
    """What the file says of one: the topic (local name) whose messages latch it, and the commands that it stops."""

    topic: TopicName
    stops: PatternSet


def says_stop(info: TopicInfo, body: bytes) -> bool:
    """Whether a message is a stop: std_msgs/Bool that is true, or any message of another type."""
    if plain_type(info.type_name) != "std_msgs/Bool":
        return True
    at = 4 if info.encoding is Encoding.CDR else 0
    return body[at : at + 1] != b"\0"


class EStops:
    """Those of one client. `halt` is called when one is latched: the commands that it stops are to be stopped now.

    Raises ConfigError when its file cannot be had."""

    def __init__(
        self, stops: Iterable[EStop], path: Path, events: EventLog, *, halt: Callable[[PatternSet], None]
    ) -> None:
        self._stops = {stop.topic: stop for stop in stops}
        self._path = path
        self._events = events
        self._halt = halt
        self._latched: dict[TopicName, str] = self._read() if self._stops else {}
        for topic, since in self._latched.items():
            words = "%s: latched since %s; commands are refused until `sern release %s`"
            events.say(_log, logging.WARNING, "e_stop", topic, words, topic, since, topic)

    @property
    def topics(self) -> Iterable[TopicName]:
        """Local names of all that there are."""
        return self._stops.keys()

    @property
    def latched(self) -> Mapping[TopicName, str]:
        """Those that are, and since when by the wall clock."""
        return self._latched

    def stopped(self, command: TopicName) -> TopicName | None:
        """Which stop keeps a command topic (local name) from being obeyed; None: none does."""
        for topic in self._latched:
            if self._stops[topic].stops.fullmatch(command):
                return topic
        return None

    def heard(self, info: TopicInfo, body: bytes, *, where: str) -> None:
        """A message of a topic has come, under its local name: from `where`. It is nothing, or a stop."""
        stop = self._stops.get(info.name)
        if stop is None or not says_stop(info, body):
            return
        known = info.name in self._latched
        self._latched.setdefault(info.name, wall_text(time.time()))
        self._halt(stop.stops)  # before the disk, which may take seconds
        if not known:
            self._write()
            words = "%s: stopped by %s; commands are refused until `sern release %s`"
            self._events.say(_log, logging.WARNING, "e_stop", info.name, words, info.name, where, info.name)

    def sink(self, info: TopicInfo, inner: Sink) -> Sink:
        """What takes the messages of a topic of this site in place of `inner`, and hears them."""

        def watched(body: bytes, stamp_ns: int) -> bool:
            self.heard(info, body, where="this site")
            return inner(body, stamp_ns)

        return watched

    def release(self, topic: TopicName, *, who: str) -> None:
        """Obey commands again. Raises UsageError for a topic that is none or is not latched."""
        if topic not in self._stops:
            known = ", ".join(sorted(self._stops)) or "there is none in the file (e_stop)"
            raise UsageError(f"{topic} is no e-stop of this client; {known}")
        if topic not in self._latched:
            raise UsageError(f"{topic} is not latched: there is nothing to release")
        del self._latched[topic]
        self._write()
        self._events.say(_log, logging.WARNING, "e_stop_released", topic, "%s: released by %s", topic, who)

    # --- the file ---------------------------------------------------------------------------------------------------

    def _read(self) -> dict[TopicName, str]:
        try:
            with self._path.open("rb") as file:
                said = json.loads(file.read(MAX_FILE_BYTES))
            return {topic: str(said[topic]) for topic in self._stops if topic in dict(said)}
        except FileNotFoundError:
            self._check_place()
            return {}
        except (OSError, ValueError, TypeError) as error:
            _log.error("%s cannot be read (%s): every e-stop counts as latched", self._path, error)
            return dict.fromkeys(self._stops, "an unknown time")

    def _check_place(self) -> None:
        if not os.access(self._path.parent, os.W_OK | os.X_OK):
            text = f"{self._path.parent} cannot be written to, and an e-stop must survive a restart; set e_stop.file"
            raise ConfigError(text)

    def _write(self) -> None:
        """Have it on disk. Where that fails the latch holds all the same, until the end of the process."""
        try:
            write_whole(self._path, json.dumps(self._latched))
        except OSError as error:
            words = "%s: the state of the e-stops could not be kept (%s): it ends with this process"
            self._events.say(_log, logging.ERROR, "e_stop_not_kept", "", words, self._path, error.strerror)
