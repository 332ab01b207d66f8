"""The topics as viewers see them: a channel for each that another site offers or that comes, and one for its age.

What is offered comes only while somebody looks (`Viewed.want`); what comes all the same (`subscribe` in the file) has
a channel while it does. Who comes late to a latched topic gets what holds now, alone; of /tf_static all that is known,
from all who publish it, as one message.
"""

import asyncio
import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

from sern_client.endpoints.base import Viewed
from sern_client.endpoints.common.ages import Ages, age_body, age_topic
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.conversion import Convert, converted
from sern_client.endpoints.foxglove import definitions
from sern_client.endpoints.foxglove.definitions import Described
from sern_client.tf_latch import TfLatch, is_static_tf
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, TopicName
from sern_runtime import ros_types

RENEWED_S: Final = 5.0
"""How long viewers have to find a channel that was described anew, before nobody looks at its topic any more."""
MAX_KEPT: Final = 1_000
MAX_KEPT_BYTES: Final = 32 * 2**20
"""What is kept of one latched topic and publisher: the newest, and one message always."""

_log = logging.getLogger(__name__)


class Channel(Protocol):
    number: int

    def close(self) -> None: ...


OpenChannel = Callable[[TopicInfo, Described], Channel]
ShowAll = Callable[[int, bytes, bool], None]
"""`show(channel, body, must)` to all who look. `must`: it holds until there is another."""
Show = Callable[[int, bytes], None]
"""`show(time_ns, body)` to one viewer."""


@dataclass(slots=True, eq=False)
class _Kept:
    """The last messages of a publisher."""

    depth: int
    bodies: deque[bytes] = field(default_factory=deque)
    nbytes: int = 0

    def add(self, body: bytes) -> None:
        self.bodies.append(body)
        self.nbytes += len(body)
        while len(self.bodies) > 1 and (len(self.bodies) > self.depth or self.nbytes > MAX_KEPT_BYTES):
            self.nbytes -= len(self.bodies.popleft())


@dataclass(slots=True, eq=False)
class _Shown:
    """A topic, its channels, and who looks at it."""

    info: TopicInfo
    channel: Channel
    age_info: TopicInfo | None
    age: Channel | None
    offered: bool = False
    wanted: bool = False
    renewed: asyncio.TimerHandle | None = None
    publishers: "list[TopicPublisher]" = field(default_factory=list)
    static: TfLatch | None = None
    kept: "dict[TopicPublisher, _Kept]" = field(default_factory=dict)
    watchers: set[int] = field(default_factory=set)
    age_watchers: set[int] = field(default_factory=set)


class TopicPublisher:
    """A `Publisher` of what comes from another site."""

    def __init__(self, board: "Board", shown: _Shown, info: TopicInfo, convert: Convert | None) -> None:
        self.name = info.name
        self.closed = False
        self._board = board
        self._shown = shown
        self._convert = convert
        self._latched = info.latched or shown.static is not None
        self._depth = min(info.depth or 1, MAX_KEPT)

    def publish(self, body: bytes, stamp_ns: int) -> None:
        if self.closed:
            self._board.dropped[DropReason.DISCONNECTED] += 1
            return
        if self._convert is not None:
            try:
                body = self._convert(body)
            except ConfigError as error:
                self._board.dropped[DropReason.UNDECODABLE] += 1
                self._board.say_once(f"{self.name}: a message cannot be shown, and others like it: {error}", self.name)
                return
        shown = self._shown
        if self._latched:
            self._keep(shown, body)
        self._board.show_all(shown.channel.number, body, self._latched)

    def _keep(self, shown: _Shown, body: bytes) -> None:
        if shown.static is not None:
            try:
                shown.static.keep(self, body)
                return
            except ConfigError as error:
                self._board.say_once(f"{self.name}: cannot be merged for who looks later: {error}", self.name)
        shown.kept.setdefault(self, _Kept(self._depth)).add(body)

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._board.ended(self, self._shown)


class Board:
    """All topics that viewers can look at. `open_channel` makes a channel at the server."""

    def __init__(self, viewed: Viewed, open_channel: OpenChannel, show_all: ShowAll) -> None:
        self.show_all = show_all
        self.dropped: Counter[DropReason] = Counter()
        self.say_once = SayOnce(_log)
        self._viewed = viewed
        self._open_channel = open_channel
        self._topics: dict[TopicName, _Shown] = {}
        self._by_number: dict[int, _Shown] = {}
        self._ages = Ages(viewed.topics, self._show_age)
        self._closed = False

    @property
    def publishers(self) -> Counter[TopicName]:
        """How many are open, by topic."""
        return Counter(each.name for shown in self._topics.values() for each in shown.publishers)

    @property
    def looked_at(self) -> Counter[TopicName]:
        """How many viewers look at each topic."""
        return Counter({name: len(shown.watchers) for name, shown in self._topics.items() if shown.watchers})

    def __len__(self) -> int:
        return len(self._topics)

    def name_of(self, number: int) -> TopicName | None:
        """The topic of a channel, its age's included."""
        shown = self._by_number.get(number)
        if shown is None:
            return None
        return shown.info.name if shown.channel.number == number or shown.age_info is None else shown.age_info.name

    # --- what there is ----------------------------------------------------------------------------------------------

    def offered(self, info: TopicInfo) -> None:
        """Another site has this topic, or describes it otherwise."""
        shown = self._topics.get(info.name)
        try:
            if shown is None:
                shown = self._add(info)
            elif not shown.publishers and not _same(shown.info, info):
                self._renew(shown, info)
        except ConfigError as error:
            self.say_once(f"viewers are not told of a topic: {error}")
            return
        shown.offered = True
        self._settle(shown)

    def withdrawn(self, name: TopicName) -> None:
        """It is gone; what still comes of it is shown to its end."""
        shown = self._topics.get(name)
        if shown is not None:
            shown.offered = shown.wanted = False
            self._forget_if_over(shown)

    def advertise(self, info: TopicInfo) -> TopicPublisher:
        """What comes is going to be shown. ConfigError where it cannot be."""
        shown = self._topics.get(info.name)
        convert: Convert | None = None
        if shown is None:
            shown = self._add(info)
        elif not _same(shown.info, info):
            if not shown.publishers:
                self._renew(shown, info)
            else:
                convert = self._fitted(shown, info)
        if shown.static is None and is_static_tf(info.name, info.type_name):
            shown.static = TfLatch(shown.info.encoding)
        publisher = TopicPublisher(self, shown, info, convert)
        shown.publishers.append(publisher)
        return publisher

    def ended(self, publisher: TopicPublisher, shown: _Shown) -> None:
        """Nothing more comes from a publisher; nobody gets what it had said."""
        shown.publishers.remove(publisher)
        shown.kept.pop(publisher, None)
        if shown.static is not None:
            shown.static.drop(publisher)
        self._forget_if_over(shown)

    def close(self) -> None:
        self._closed = True
        self._ages.close()
        for shown in self._topics.values():
            if shown.renewed is not None:
                shown.renewed.cancel()
            self._close_channels(shown)
        self._topics.clear()

    def _add(self, info: TopicInfo) -> _Shown:
        shown = _Shown(info, self._open(info), *self._age_of(info))
        self._topics[info.name] = shown
        self._number(shown)
        return shown

    def _open(self, info: TopicInfo) -> Channel:
        described = definitions.of_topic(info)
        if not described.text:
            self.say_once(f"{info.name}: nobody knows the definition of {info.type_name}, so viewers cannot read it")
        return self._open_channel(info, described)

    def _age_of(self, info: TopicInfo) -> tuple[TopicInfo | None, Channel | None]:
        age = age_topic(info)
        if age is None or age.name in self._topics:
            return None, None
        return age, self._open_channel(age, definitions.of_topic(age))

    def _number(self, shown: _Shown) -> None:
        self._by_number[shown.channel.number] = shown
        if shown.age is not None:
            self._by_number[shown.age.number] = shown

    def _renew(self, shown: _Shown, info: TopicInfo) -> None:
        """Describe a topic anew: viewers find another channel of its name, and most ask for it at once."""
        if definitions.of_topic(info) == definitions.of_topic(shown.info):
            shown.info = info  # as was known before it was said; and of two such channels the server makes one
            return
        channel = self._open(info)
        looked_at = shown.wanted
        self._close_channels(shown)
        shown.info, shown.channel = info, channel
        shown.age_info, shown.age = self._age_of(info)
        shown.static = None
        self._number(shown)
        if looked_at:
            if shown.renewed is not None:
                shown.renewed.cancel()
            shown.renewed = asyncio.get_running_loop().call_later(RENEWED_S, self._renewal_over, shown)

    def _renewal_over(self, shown: _Shown) -> None:
        shown.renewed = None
        self._settle(shown)

    def _fitted(self, shown: _Shown, info: TopicInfo) -> Convert | None:
        """What makes messages of a second publisher fit the channel; ConfigError where nothing does."""
        mine, theirs = shown.info, info
        if ros_types.canonical(mine.type_name) != ros_types.canonical(theirs.type_name):
            raise ConfigError(
                f"{info.name}: what comes is {theirs.type_name}, and viewers are shown {mine.type_name} of another site"
            )
        if mine.encoding is theirs.encoding:
            raise ConfigError(
                f"{info.name}: two sites have {mine.type_name} with different definitions; viewers are shown the first"
            )
        return converted(info, mine.encoding)[1]

    def _forget_if_over(self, shown: _Shown) -> None:
        if shown.offered or shown.publishers or self._closed:
            return
        if shown.renewed is not None:
            shown.renewed.cancel()
        self._close_channels(shown)
        del self._topics[shown.info.name]

    def _close_channels(self, shown: _Shown) -> None:
        for channel in (shown.channel, shown.age):
            if channel is not None:
                self._by_number.pop(channel.number, None)
                channel.close()
        shown.watchers.clear()
        shown.age_watchers.clear()
        self._ages.look(shown.info.name, looked=False)

    # --- who looks --------------------------------------------------------------------------------------------------

    def looks(self, client: int, number: int, *, looks: bool) -> None:
        """A viewer looks at a channel, or does not any more."""
        shown = self._by_number.get(number)
        if shown is None:  # it is closed meanwhile
            return
        of_age = shown.channel.number != number
        watchers = shown.age_watchers if of_age else shown.watchers
        (watchers.add if looks else watchers.discard)(client)
        if of_age:
            self._ages.look(shown.info.name, looked=bool(watchers))
            return
        if looks and shown.renewed is not None:
            shown.renewed.cancel()
            shown.renewed = None
        self._settle(shown)

    def _settle(self, shown: _Shown) -> None:
        """Say whether somebody looks, where that is new."""
        wanted = shown.offered and (bool(shown.watchers) or shown.renewed is not None)
        if wanted != shown.wanted:
            shown.wanted = wanted
            self._viewed.want(shown.info.name, wanted)

    def missed(self, number: int, show: Show) -> None:
        """Show one who has come now what was said before and holds."""
        shown = self._by_number.get(number)
        if shown is None or shown.channel.number != number:
            return
        now_ns = time.time_ns()
        merged = None if shown.static is None else shown.static.merged()
        if merged is not None:
            show(now_ns, merged)
        for kept in shown.kept.values():
            for body in kept.bodies:
                show(now_ns, body)

    def _show_age(self, name: TopicName, age_s: float) -> None:
        shown = self._topics.get(name)
        if shown is not None and shown.age is not None and shown.age_info is not None:
            self.show_all(shown.age.number, age_body(age_s, shown.age_info.encoding), False)


def _same(mine: TopicInfo, theirs: TopicInfo) -> bool:
    """Whether both can be shown in one channel: what one of them does not say of its type may be the same."""
    if (ros_types.canonical(mine.type_name), mine.encoding) != (ros_types.canonical(theirs.type_name), theirs.encoding):
        return False
    if mine.definition == theirs.definition or not theirs.definition:
        return True
    return bool(mine.type_hash) and mine.type_hash == theirs.type_hash and bool(mine.definition)
