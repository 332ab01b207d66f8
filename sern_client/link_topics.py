"""The state of links as ROS messages: what is published on /NAME/sern/link, /sern/link and /diagnostics.

`diagnostic_msgs` has what is needed: a level that every tool can colour (OK, ERROR, STALE), a line for people, and
named values for programs, in a package that every installation of ROS 1 and ROS 2 has.
"""

import logging
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import Final, NamedTuple

from sern_client.endpoints.base import Publisher
from sern_core.site.peers import PeerStatus
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock, ros_types

STATUS_TYPE: Final = "diagnostic_msgs/msg/DiagnosticStatus"
ARRAY_TYPE: Final = "diagnostic_msgs/msg/DiagnosticArray"
VALUE_TYPE: Final = "diagnostic_msgs/msg/KeyValue"
OWN_TOPIC: Final = TopicName("/sern/link")
DIAGNOSTICS: Final = TopicName("/diagnostics")
LEVELS: Final = {PeerStatus.CONNECTED: 0, PeerStatus.GONE: 2, PeerStatus.UNKNOWN: 3}
"""OK, ERROR and STALE of DiagnosticStatus."""

_log = logging.getLogger(__name__)


class LinkView(NamedTuple):
    """A link at one time, our own to the relay (`own`) or the way to a peer. Seconds; None: not known.

    `since_s`: for how long the status has been so; `age_s`: since a message came from there; `round_trip_s`: of the
    way to `round_trip_to`; `lane`: of the far end's hop to the relay (of the own link: ours); `why`: in a few words.
    `given_up`: the relay waits for the peer no longer.
    """

    peer: str
    own: bool
    status: PeerStatus
    since_s: float
    age_s: float | None
    round_trip_s: float | None
    round_trip_to: str
    lane: str
    why: str
    given_up: bool = False

    @property
    def topic(self) -> TopicName:
        return OWN_TOPIC if self.own else peer_topic(self.peer)

    @property
    def line(self) -> str:
        """The state in words: jackal1 is gone for 12 s."""
        if self.status is PeerStatus.CONNECTED:
            return f"{self.peer} is connected"
        why = f" ({self.why})" if self.why else ""
        return f"{self.peer} is {self.status} for {self.since_s:.0f} s{why}"

    def values(self) -> dict[str, str]:
        """The state as keys and values for programs; empty where not known."""
        return {
            "connected": "true" if self.status is PeerStatus.CONNECTED else "false",
            "status": str(self.status),
            "since_s": _number(self.since_s),
            "age_s": _number(self.age_s),
            "round_trip_s": _number(self.round_trip_s),
            "round_trip_to": self.round_trip_to,
            "lane": self.lane,
        }


def peer_topic(peer: str) -> TopicName:
    """Where the state of a peer is published: below its name, as its own topics usually are."""
    return TopicName(f"/{peer}{OWN_TOPIC}")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


class LinkTopics:
    """Publishes views at an endpoint. `client` is our name, `advertise` the endpoint's; `encoding` of the bodies."""

    def __init__(
        self, client: str, encoding: Encoding, advertise: Callable[[TopicInfo], Publisher], *, diagnostics: bool
    ) -> None:
        self._client = client
        self._encoding = encoding
        self._advertise = advertise
        self._diagnostics = diagnostics
        self._publishers: dict[TopicName, Publisher] = {}
        self._problems: dict[TopicName, tuple[str, float]] = {}  # what was said of it last, and since when
        self._final: dict[TopicName, tuple[PeerStatus, object]] = {}  # what was published of those that are given up
        self._seq = 0

    @property
    def held(self) -> Counter[TopicName]:
        """Our publishers, by local name."""
        return Counter(self._publishers.keys())

    def publish(self, views: Sequence[LinkView], stamp_ns: int) -> None:
        """Publish all of them as they are now; the topics of others end. A peer that is given up is said once, and on
        /diagnostics as it was then: there may be many of them, for ever."""
        wanted = {view.topic for view in views} | ({DIAGNOSTICS} if self._diagnostics else set())
        for name in [name for name in self._publishers if name not in wanted]:
            self._final.pop(name, None)
            self._publishers.pop(name).close()
        statuses = [self._said(view, stamp_ns) for view in views]
        if self._diagnostics:
            self._seq = (self._seq + 1) & 0xFFFFFFFF
            header = ros_types.header(stamp_ns, "", self._encoding, self._seq)
            array = ros_types.new(ARRAY_TYPE, self._encoding, header=header, status=statuses)
            body = ros_types.serialise(array, ARRAY_TYPE, self._encoding)
            self._publish(DIAGNOSTICS, ARRAY_TYPE, body, stamp_ns, latched=False)

    def _said(self, view: LinkView, stamp_ns: int) -> object:
        """The status of a link, which its topic has as well now."""
        topic = view.topic
        was, final = self._final.get(topic, (None, None))
        if view.given_up and was is view.status:
            return final
        status = self._status(view)
        body = ros_types.serialise(status, STATUS_TYPE, self._encoding)
        published = self._publish(topic, STATUS_TYPE, body, stamp_ns, latched=True)
        if view.given_up and published:
            self._final[topic] = view.status, status
        else:
            self._final.pop(topic, None)
        return status

    def _status(self, view: LinkView) -> object:
        values = [
            ros_types.new(VALUE_TYPE, self._encoding, key=key, value=value) for key, value in view.values().items()
        ]
        return ros_types.new(
            STATUS_TYPE,
            self._encoding,
            level=LEVELS[view.status],
            name=f"sern {self._client}: {view.peer}",
            message=view.line,
            hardware_id=view.peer,
            values=values,
        )

    def _publish(self, name: TopicName, type_name: str, body: bytes, stamp_ns: int, *, latched: bool) -> bool:
        """False: it cannot be published there."""
        publisher = self._publishers.get(name) or self._open(name, type_name, latched=latched)
        if publisher is not None:
            publisher.publish(body, stamp_ns)
        return publisher is not None

    def _open(self, name: TopicName, type_name: str, *, latched: bool) -> Publisher | None:
        """Tried again each time, and said once."""
        info = ros_types.topic_info(name, type_name, self._encoding, latched=latched, reliable=True)
        try:
            publisher = self._publishers[name] = self._advertise(info)
        except ConfigError as error:
            said, since_s = self._problems.get(name, ("", clock.now()))
            if said != str(error):
                self._problems[name] = str(error), since_s
                _log.warning("the state of the link is not published there (link_state in the file): %s", error)
            return None
        if (problem := self._problems.pop(name, None)) is not None:
            _log.warning("%s: the state of the link is published now, after %.0f s", name, clock.now() - problem[1])
        return publisher

    def repair(self, names: Collection[TopicName]) -> None:
        """These are not open at the endpoint as they should be: they are opened anew with the next message."""
        for name in names:
            self._final.pop(name, None)
            publisher = self._publishers.pop(name, None)
            if publisher is not None:
                with suppress(Exception):  # it is not what it should be
                    publisher.close()

    def close(self) -> None:
        while self._publishers:
            self._publishers.popitem()[1].close()
