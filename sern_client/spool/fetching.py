"""Fetches what robots have kept and this site lacks, into files beside its recording (`sern_core.site.spool`)."""

import asyncio
import logging
import secrets
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from sern_client.endpoints.base import KeepingEndpoint
from sern_client.frames import Rewrite
from sern_client.keeping import KeeperNumbers, Numbers
from sern_client.site import Site
from sern_client.spool import ledger, orders
from sern_core.site.client import ClientCore
from sern_core.site.peers import PeerStatus
from sern_core.site.spool import (
    ALWAYS,
    FETCHED,
    SETTLE_S,
    Missing,
    TopicFetch,
    Window,
    decode_report,
    encode_request,
)
from sern_core.stream.out_channel import OutChannel
from sern_core.topics.patterns import Pattern
from sern_core.topics.spool_names import SpoolStream, SpoolStreamKind, fetch_name
from sern_core.vocabulary.errors import ConfigError, UsageError, WireError
from sern_core.vocabulary.ledger import MAX_TOPICS
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, PriorityClass, Reliability, TopicName
from sern_runtime import clock
from sern_runtime.spool.files import Kept, KeptStream
from sern_runtime.spool.keeper import SpoolKeeper

REQUEST_TYPE: Final = "sern/Fetch"
ORDERS_S: Final = 2.0
"""How often it is looked for what people ask for."""
SAVE_S: Final = 5.0
"""How often it is written down at most what is here."""
SILENT_S: Final = 120.0
"""A robot that has sent nothing of what it was asked for so long is asked again."""

NOBODY: Final = ClientName("")
"""The origin of a topic that was kept once, and that nobody offers now."""

_log = logging.getLogger(__name__)

_REQUEST_SPEC: Final = TopicSpec(PriorityClass.STATE, reliability=Reliability.RELIABLE, depth=100, lifespan_s=None)


@dataclass(slots=True, eq=False)
class _Remote:
    """A topic that a robot keeps. `there`: the robot offers it now, and is here."""

    topic: TopicName
    fetch: TopicFetch
    origin: ClientName = NOBODY
    there: bool = False
    reports: StreamId | None = None
    answers: StreamInfo | None = None
    stream: KeptStream | None = None  # as it is recorded here, but for its boot
    rewrite: Rewrite | None = None
    requests: OutChannel | None = None
    heard_s: float = 0.0
    since_s: float = 0.0  # since when `reports` is there
    messages: int = 0
    nbytes: int = 0


class SpoolFetching:
    """`start` once the loop runs, `look` about twice a second, then `close`. `topics`: global names to fetch;
    `automatic`: without being asked."""

    def __init__(
        self,
        core: ClientCore,
        site: Site,
        keeper: SpoolKeeper,
        *,
        topics: tuple[Pattern, ...],
        automatic: bool,
        keepers: Sequence[KeepingEndpoint],
    ) -> None:
        self.unasked = 0
        """Messages that came as fetched and were not asked for, or are here already."""
        self.refused = 0
        """Messages from robots that are not what they ought to be."""
        self._core = core
        self._site = site
        self._keeper = keeper
        self._topics = topics
        self._automatic = automatic
        self._live = KeeperNumbers(keepers, self._live_kept)
        self._remotes: dict[TopicName, _Remote] = {}
        self._orders: dict[Path, orders.Order] = {}
        self._ordered_s: dict[Path, float] = {}  # since when each is known
        self._said_orders: set[str] = set()
        self._passed: set[TopicName] = set()  # live topics that are not fetched
        self._said: set[str] = set()
        self._looked_s = 0.0
        self._saved_s = 0.0
        self._changed = False
        self._saving: asyncio.Future[None] | None = None
        self._started = False
        self._closed = False

    @property
    def directory(self) -> Path:
        return self._keeper.store.directory

    def start(self) -> None:
        """Read what earlier processes knew. Where that cannot be, it is said, and this process fetches nothing."""
        if self._keeper.problem is not None:
            return  # which was said
        try:
            (self.directory / orders.FOLDER).mkdir(exist_ok=True)
            known = ledger.load(self.directory)
        except OSError as error:
            _log.error("%s: nothing is fetched by this process (%s); mend it and start it again", self.directory,
                       error.strerror)  # fmt: skip
            return
        self._started = True
        for topic, boots in known.items():
            if len(self._remotes) < MAX_TOPICS:
                remote = self._remotes[topic] = _Remote(topic, TopicFetch(secrets.randbits(62)))
                for boot, runs in boots.items():
                    for first, last in runs:
                        remote.fetch.have(boot, first, last)

    # --- from the link ----------------------------------------------------------------------------------------------

    def stream_opened(self, stream: StreamInfo, parts: SpoolStream) -> None:
        """A stream of a robot. ConfigError where it is nothing for this site."""
        topic, origin = parts.topic, stream.id.origin
        if not any(pattern.fullmatch(topic) for pattern in self._topics):
            raise ConfigError(f"{topic} is not in spool.fetch")
        if parts.kind is SpoolStreamKind.FETCHED:
            self._answers(stream, parts)
            return
        remote = self._remotes.get(topic)
        if remote is None:
            if len(self._remotes) >= MAX_TOPICS:
                raise ConfigError(f"{MAX_TOPICS} topics are fetched here already; name fewer in spool.fetch")
            remote = self._remotes[topic] = _Remote(topic, TopicFetch(secrets.randbits(62)))
        if remote.reports is not None:
            self._gone(remote)
        remote.origin, remote.reports = origin, stream.id
        remote.heard_s = remote.since_s = clock.now()
        _log.info("%s keeps %s", origin, topic)

    def _answers(self, stream: StreamInfo, parts: SpoolStream) -> None:
        remote = self._remotes.get(parts.topic)
        if remote is None or parts.site != self._core.name or stream.info.encoding is Encoding.RAW:
            raise ConfigError(f"{stream.id.topic} is not for this site")
        name = self._site.rules.inward(parts.topic, namespace=self._site.namespace)
        info = replace(stream.info, name=name, reliable=None)
        remote.answers = stream
        remote.rewrite = self._site.frames.incoming(info)
        remote.stream = KeptStream(StreamId(stream.id.origin, 0, name), info)

    def stream_closed(self, stream: StreamInfo) -> None:
        for remote in self._remotes.values():
            if remote.reports == stream.id:
                self._gone(remote)
            elif remote.answers is not None and remote.answers.id == stream.id:
                remote.answers = None
                remote.fetch.torn()

    def _gone(self, remote: _Remote) -> None:
        """Nobody offers the topic any more: what was asked will not be answered."""
        remote.there, remote.reports = False, None
        remote.fetch.forget_requests()
        self._withdraw(remote)

    def _withdraw(self, remote: _Remote) -> None:
        if remote.requests is not None:
            self._core.unpublish(remote.requests, now=clock.now())
            remote.requests = None
            self._site.kick()

    def message(self, stream: StreamInfo, message: Message, parts: SpoolStream) -> None:
        """A report, something that was asked for, or the end of it."""
        remote = self._remotes.get(parts.topic)
        if remote is None:
            return
        try:
            if stream.id == remote.reports:
                remote.fetch.reported(decode_report(message.body), now=clock.now())
                self._ask(remote)
            elif remote.answers is not None and stream.id == remote.answers.id and stream.id.origin == remote.origin:
                remote.heard_s = clock.now()
                self._fetched(remote, message)
        except WireError as error:
            self.refused += 1
            self._say_once(f"{stream.id.topic} of {stream.id.origin}: {error}")

    def _fetched(self, remote: _Remote, message: Message) -> None:
        """Raises WireError."""
        if len(message.body) < FETCHED.size:
            raise WireError("what was fetched is too short to be a message")
        boot, number = FETCHED.unpack_from(message.body)
        if not boot:
            remote.fetch.done(number)
            self._ask(remote)
            return
        if remote.stream is None or not remote.fetch.accept(boot, number):
            self.unasked += 1
            return
        body = message.body[FETCHED.size :]
        if remote.rewrite is not None:
            body = remote.rewrite(body)
        # Under its global name, which is how it is found again; the recorded name is in the info.
        stream = KeptStream(StreamId(remote.origin, boot, remote.topic), remote.stream.info)
        if not self._keeper.put(Kept(stream, number, message.stamp_ns, body)):
            remote.fetch.lost(boot, number)

    def expired(self, stream: StreamInfo) -> None:
        """Something of a stream of ours was lost on its way."""
        for remote in self._remotes.values():
            if remote.answers is not None and remote.answers.id == stream.id:
                remote.fetch.torn()

    def kept(self, messages: Sequence[Kept], safe: bool) -> None:
        """The keeper's news: these are recorded, or they are not."""
        for message in messages:
            remote = self._remotes.get(message.stream.id.topic)
            if remote is None:
                continue
            if safe:
                remote.fetch.recorded(message.stream.id.boot, message.seq)
                remote.messages += 1
                remote.nbytes += len(message.body)
                self._changed = True
            else:
                remote.fetch.lost(message.stream.id.boot, message.seq)

    # --- what comes live --------------------------------------------------------------------------------------------

    def mark(self, stream: StreamId) -> Numbers | None:
        """Call it before a live message is published. Returns what `published` is to be given; None: its topic is not
        fetched."""
        remote = self._remotes.get(stream.topic) or self._maybe_kept(stream.topic)
        if remote is None:
            return None
        if remote.origin == NOBODY:
            remote.origin = stream.origin
        if remote.origin != stream.origin:
            return None
        remote.fetch.began(stream.boot)
        return self._live.mark()

    def _maybe_kept(self, topic: TopicName) -> _Remote | None:
        """A live topic that its robot may turn out to keep: what came before it says so must be known then."""
        if topic in self._passed or len(self._remotes) >= MAX_TOPICS:
            return None
        if not any(pattern.fullmatch(topic) for pattern in self._topics):
            if len(self._passed) < MAX_TOPICS:
                self._passed.add(topic)
            return None
        remote = self._remotes[topic] = _Remote(topic, TopicFetch(secrets.randbits(62)))
        return remote

    def published(self, stream: StreamId, seq: int, mark: Numbers) -> None:
        """A live message was published since `mark`. What no recording has taken is here all the same."""
        if not self._live.published(stream, seq, mark):
            self._live_kept(stream, seq, None)

    def _live_kept(self, stream: StreamId, seq: int, lost: DropReason | None) -> None:
        """A recording has a live message, or lost it: then it is missing, unless another one has it."""
        remote = self._remotes.get(stream.topic)
        if remote is not None and lost is None:
            remote.fetch.have(stream.boot, seq, seq)
            self._changed = True

    # --- what is asked ----------------------------------------------------------------------------------------------

    def look(self) -> None:
        """Ask for what is missing, and write down what is here. Call about twice a second."""
        if not self._started:
            return
        now = clock.now()
        if now - self._looked_s >= ORDERS_S:
            self._looked_s = now
            self._look_for_orders()
        here = {peer.name for peer in self._core.look_at_peers(now=now) if peer.status is PeerStatus.CONNECTED}
        for remote in self._remotes.values():
            remote.there = remote.reports is not None and remote.origin in here
            if remote.reports is not None:
                self._look_at(remote, now)
        if self._changed and now - self._saved_s >= SAVE_S and self._saving is None:
            self._save(now)

    def _look_at(self, remote: _Remote, now: float) -> None:
        link = self._core.link
        if not remote.fetch.under_way or not link.established or link.lane.stalled or not remote.there:
            remote.heard_s = now
        elif now - remote.heard_s > SILENT_S:
            _log.warning("%s has not answered for %g s what it was asked of %s; it is asked again", remote.origin,
                         SILENT_S, remote.topic)  # fmt: skip
            remote.heard_s = now
            remote.fetch.forget_requests()
        self._ask(remote)

    def _windows(self, remote: _Remote) -> list[Window]:
        asked = [order.window for order in self._orders.values() if order.topic == remote.topic]
        return [*asked, *([ALWAYS] if self._automatic else [])]

    def _ask(self, remote: _Remote) -> None:
        if self._closed or not self._started or remote.reports is None or self._keeper.problem is not None:
            return
        now = clock.now()
        windows = self._windows(remote)
        while windows and (request := remote.fetch.ask(windows, now=now)) is not None:
            channel = self._request_channel(remote)
            if channel is None or not self._core.send(channel, encode_request(request), time.time_ns(), now=now):
                remote.fetch.forget_requests()
                return
            self._site.kick()

    def _request_channel(self, remote: _Remote) -> OutChannel | None:
        if remote.requests is None:
            info = TopicInfo(fetch_name(remote.topic, self._core.name), REQUEST_TYPE, Encoding.RAW)
            try:
                remote.requests = self._core.publish(info, _REQUEST_SPEC, required=(remote.origin,), now=clock.now())
            except UsageError as error:
                self._say_once(f"{remote.topic} cannot be fetched: {error}")
        return remote.requests

    def _look_for_orders(self) -> None:
        try:
            there = orders.look(self.directory, self._said_orders)
        except OSError as error:
            self._say_once(f"{self.directory / orders.FOLDER}: it cannot be seen what is asked for ({error.strerror})")
            return
        for path in self._orders.keys() - there.keys():
            self._end_order(path)
        now = clock.now()
        for path in there.keys() - self._orders.keys():
            self._orders[path], self._ordered_s[path] = there[path], now
        for path, order in list(self._orders.items()):
            remote = self._remotes.get(order.topic)
            if remote is None or not remote.there:
                continue
            # What was kept just before may still come live: only then it is known what of it is missing.
            known_s = max(self._ordered_s[path], remote.since_s) + SETTLE_S + ORDERS_S
            if now >= known_s and remote.fetch.answered(order.window, now=now):
                _log.info("%s: what was asked of it has been fetched", order.topic)
                try:
                    path.unlink(missing_ok=True)
                except OSError as error:
                    self._say_once(f"{path} cannot be removed ({error.strerror})")
                self._end_order(path)

    def _end_order(self, path: Path) -> None:
        order = self._orders.pop(path)
        del self._ordered_s[path]
        remote = self._remotes.get(order.topic)
        if remote is not None and order.window not in (other.window for other in self._orders.values()):
            remote.fetch.forget_window(order.window)

    # --- what is here -----------------------------------------------------------------------------------------------

    def _content(self) -> ledger.Ledger:
        return {
            topic: {boot: tuple(runs) for boot, runs in remote.fetch.had()} for topic, remote in self._remotes.items()
        }

    def _save(self, now: float) -> None:
        self._changed, self._saved_s = False, now
        content = self._content()
        self._saving = asyncio.get_running_loop().run_in_executor(None, ledger.save, self.directory, content)
        self._saving.add_done_callback(self._saved)

    def _saved(self, future: "asyncio.Future[None]") -> None:
        self._saving = None
        if future.cancelled():
            return
        error = future.exception()
        if isinstance(error, OSError):
            self._save_failed(error)
        elif error is not None:
            raise error

    def _save_failed(self, error: OSError) -> None:
        self._changed = True
        self._say_once(
            f"{self.directory / ledger.FILE} cannot be written ({error.strerror}): what is fetched now is fetched "
            "again by the next process"
        )

    def missing(self) -> dict[TopicName, Missing]:
        """What robots have and this site lacks, by topic."""
        return {topic: remote.fetch.missing() for topic, remote in self._remotes.items()}

    def counts(self) -> Counter[str]:
        """What is not fetched any more, by why."""
        found: Counter[str] = Counter(gone=0, given_up=0)
        for remote in self._remotes.values():
            found["gone"] += remote.fetch.gone
            found["given_up"] += remote.fetch.given_up
        return found

    def to_json(self) -> dict[str, object]:
        """What there is of each topic, and what people asked for."""
        return {
            "fetch": [_row(remote) for remote in self._remotes.values() if remote.there or remote.fetch.spans],
            "orders": [
                {"topic": order.topic, "from_ns": order.window.from_ns, "to_ns": order.window.to_ns, "file": path.name}
                for path, order in self._orders.items()
            ],
            "automatic": self._automatic,
        }

    def _say_once(self, text: str) -> None:
        if text not in self._said and len(self._said) < MAX_TOPICS:
            self._said.add(text)
            _log.error("%s", text)

    async def close(self) -> None:
        """Write down what is here. Idempotent; after the keeper is closed."""
        if self._closed or not self._started:
            return
        self._closed = True
        if self._saving is not None:
            await asyncio.wait([self._saving])
        try:
            ledger.save(self.directory, self._content())
        except OSError as error:
            self._save_failed(error)


def _row(remote: _Remote) -> dict[str, object]:
    missing, spans = remote.fetch.missing(), remote.fetch.spans.values()
    return {
        "topic": remote.topic,
        "origin": remote.origin,
        "there": remote.there,
        "kept_messages": sum(span.messages for span in spans),
        "kept_bytes": sum(span.nbytes for span in spans),
        "first_ns": min((span.first_ns for span in spans), default=None),
        "last_ns": max((span.last_ns for span in spans), default=None),
        "missing_messages": missing.messages,
        "missing_bytes": missing.nbytes,
        "fetched_messages": remote.messages,
        "fetched_bytes": remote.nbytes,
        "gone_messages": remote.fetch.gone,
        "given_up_messages": remote.fetch.given_up,
        "under_way": remote.fetch.under_way,
    }
