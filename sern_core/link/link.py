"""One end of one hop: its parts, and what its owner calls. No I/O, clock or randomness.

A hop is a pair of links. Each end announces the streams it has, is told which of them are wanted, and sends those as
scheduler and window allow.

A link lives as long as its owner remembers the peer's name; sessions come and go inside it. What survives a session:
queues, retained reliable messages, delivered counts. What does not: channel numbers and control messages, so every
session announces everything again.

A datagram is read whole, or its session ends: whatever goes wrong in it, by the peer's fault or by ours, ends the
session before anything of it is acknowledged, on whichever lane it came. What it carried comes again in the next one,
and what had its turn is known. A lane alone would not do: what was said after it would wait for ever for what was lost.

The owner calls `receive`, `next_datagram`, `next_deadline` and `handle_timeout`, each with the time, and is told what
happens through its `LinkHandler`. Messages and streams out go through `sender` and `outgoing`, answers to the peer's
streams through `answers` and `taking`. Whoever only watches the link, or adapts it, has `observe`, `topics` and `apply`
for a door and looks at no part.
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Final

from sern_core.bodies.codecs import Coder
from sern_core.link import view
from sern_core.link.answers import Answers
from sern_core.link.composer import Composer
from sern_core.link.control_reader import ControlReader
from sern_core.link.control_stream import ControlStream
from sern_core.link.data_plane import DataPlane
from sern_core.link.definitions import DefinitionStore, PeerDefinitions
from sern_core.link.end import End
from sern_core.link.handler import LinkHandler, Owner
from sern_core.link.handshake import Handshake
from sern_core.link.housekeeping import Housekeeping
from sern_core.link.lane_set import LaneSet
from sern_core.link.name_lists import NameLists
from sern_core.link.reading import Reading
from sern_core.link.receiver import Receiver
from sern_core.link.send_trace import SendTrace
from sern_core.link.sender import Sender
from sern_core.link.session import Session
from sern_core.link.streams_in import StreamsIn
from sern_core.link.streams_out import StreamsOut
from sern_core.link.view import Counted, Held, LinkSettings, LinkView, Sending, TopicView, Undelivered
from sern_core.path.lanes import LANE_UDP, LANE_ZMQ, Lane
from sern_core.stream.in_stream import Reassembly
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import RemoteError
from sern_core.vocabulary.ledger import SendCounters
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicSpec
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import ClientName, PriorityClass, TopicName
from sern_core.wire import framing

NUMBER_AND_STAMP: Final = struct.Struct("!IQ")


class Link:
    """One end of one hop towards `peer`.

    `towards_relay`: whether the peer is a relay; None: it is if this end says HELLO, which is a client's.
    `definitions` is shared by all links of a process. `auto_confirm`: what had its turn here is delivered; a relay
    confirms by hand, when its subscribers have. `lossless`, `any_size` and `leased` say what the lane is on which the
    session begins (`path.lanes.Lane`).
    """

    def __init__(
        self,
        *,
        name: ClientName,
        boot: int,
        peer: ClientName,
        initiator: bool,
        handler: LinkHandler["Link"],
        definitions: DefinitionStore,
        link: LinkParams,
        scheduler: SchedulerParams,
        trace: DecisionTrace,
        now: float,
        lossless: bool = True,
        any_size: bool | None = None,
        leased: bool = False,
        auto_confirm: bool = True,
        towards_relay: bool | None = None,
    ) -> None:
        self.definitions = definitions
        self.finish: Callable[[Link, float], bool] | None = None
        """Called before more is read: whether all that came of what was read before is done by now."""
        self.heard_s: float | None = None
        """When the peer was last heard, on whatever lane; None: never."""
        self.heard_bytes = 0
        """Bytes of all that it has sent, headers included."""
        self._unreadable: RemoteError | None = None  # found at a time when nobody could be told
        end = self.end = End(
            name=name,
            boot=boot,
            peer=peer,
            initiator=initiator,
            towards_relay=initiator if towards_relay is None else towards_relay,
            params=link,
            trace=trace,
            now=now,
        )
        owner = self._owner = Owner(self, handler, end)
        self.texts = PeerDefinitions(definitions, peer, max_bytes=link.limits.peer_definition_bytes)
        reassembly = self.reassembly = Reassembly(max(64 * 2**20, 2 * link.max_message_bytes), link.limits)
        control = self.control = ControlStream(end, reassembly, self._read_control)
        sender = self.sender = Sender(end, scheduler, SendTrace(end, self.texts), delivered=self._delivered, now=now)
        lanes = self.lanes = LaneSet(
            end,
            lossless=lossless,
            any_size=any_size,
            leased=leased,
            paper=sender.paper,
            settled=self._settled,
            give_back=self._give_back,
            on_rate=self._rate_known,
            now=now,
        )
        self._name_lists = NameLists(link.limits.required)
        answers = self.answers = Answers(end, control, reassembly)
        self.outgoing = StreamsOut(
            end, control, sender, self.texts, self._name_lists, reassembly, owner, at_once=self._at_once
        )
        taking = self.taking = StreamsIn(
            end,
            control,
            answers,
            self.texts,
            reassembly,
            lanes,
            owner,
            auto_confirm=auto_confirm,
            answered=self._answered,
            finished=self._finished,
        )
        self._control_reader = ControlReader(
            end,
            control,
            sender,
            self.outgoing,
            taking,
            answers,
            self.texts,
            self._name_lists,
            owner,
            answered=self._answered,
        )
        composer = Composer(end, lanes, control, sender, taking, self.outgoing.control_sent, now=now)
        housekeeping = self.housekeeping = Housekeeping(sender, taking, leased=leased, now=now)
        plane = self.plane = DataPlane(end, lanes, control, sender, taking, answers, composer, housekeeping)
        self.receiver = Receiver(end, lanes, control, sender, taking, plane, reassembly, owner)
        self.reading = Reading(end, lanes, self.receiver, reassembly, taking.go_on)
        session = self._session = Session(
            end,
            lanes,
            control,
            sender,
            self.outgoing,
            taking,
            answers,
            self.texts,
            self._name_lists,
            reassembly,
            self.reading,
            owner,
        )
        self.handshake = Handshake(end, lanes, reassembly, session, owner)

    # --- how the parts hang together ------------------------------------------------------------------------------

    def _read_control(self, message: Message) -> None:
        self._control_reader.read(message)

    def _settled(self) -> bool:
        return self.control.settled

    def _give_back(self, lane: Lane, items: list[object], now: float) -> None:
        self.plane.give_back(lane, items, now)

    def _rate_known(self, rate_bps: float | None, full: bool, now: float) -> None:
        self.sender.scheduler.set_rate(rate_bps, now=now, full=full)

    def _delivered(self, channel: OutChannel) -> None:
        self.outgoing.delivered(channel)

    def _at_once(self, channel: OutChannel) -> bool:
        """Whether data may follow its announcement at once: on a stream lane, if the same peer wanted it before."""
        lanes = self.lanes
        return bool(
            lanes.lane.lossless
            and self.end.resumed
            and channel.wanted
            and not (channel.spec.priority is PriorityClass.CONTROL and lanes.priority_lane is not None)
        )

    def _finished(self, now: float) -> bool:
        return self.finish is None or self.finish(self, now)

    def _answered(self, count: int) -> None:
        self.control.answered(count, streams=len(self.sender.channels) + len(self.taking.incoming))

    # --- sessions -------------------------------------------------------------------------------------------------

    def connected(self, *, now: float) -> None:
        """The stream lane's transport is there. The initiator says hello; the other side waits for it."""
        self.handshake.connected(now)

    def disconnected(self, *, now: float, reason: str = "connection lost") -> None:
        """The stream lane's transport is gone. The session goes on over the datagram lane, if there is one."""
        self.handshake.disconnected(reason, now)

    def accept(
        self, hello: framing.Envelope, tag: int, stamp_us: int, *, now: float, another_connection: bool = False
    ) -> bool:
        """The relay's end: a peer whose name and key were checked says hello; WELCOME is queued.

        False: an old HELLO that the network delivered late, or one that comes too soon. Raises WireError, or
        VersionError when no wire version is common; the caller refuses then.
        """
        try:
            return self.handshake.accept(hello, tag, stamp_us, now, another_connection=another_connection)
        except RemoteError:
            raise
        except Exception as error:  # noqa: BLE001  (an error of ours ends the session that it was to begin)
            self.failed(error, now=now)
            return True

    def close(self, reason: str, *, now: float, moved: bool = False) -> None:
        """End the session on purpose and tell the peer. The transport stays. `moved`: we go on at another relay."""
        self.handshake.close(reason, now, moved=moved)

    def failed(self, error: Exception, *, now: float) -> None:
        """An error of ours on this link: the owner is told, and the session ends; the next one begins in order."""
        self.end.now = now
        self._owner.fault(error)
        self.handshake.abort(f"internal error ({type(error).__name__})", now)

    def fault(self, error: Exception) -> None:
        """Tell the owner of an error of ours that costs no more than what it was about."""
        self._owner.fault(error)

    def open_lane(self, *, now: float, lane_id: int = LANE_UDP) -> None:
        """Another lane has a transport (admitted in the session): ask whether it works, then use it."""
        self.lanes.open(lane_id, now)

    def close_lane(self, *, now: float, lane_id: int = LANE_UDP, reason: str = "both lanes are gone") -> None:
        """A lane's transport is gone or its keys are used up. `reason`: of the session's end, if that was its last."""
        lane = self.lanes.by_id.pop(lane_id, None)
        if lane is None:
            return
        self.end.now = now
        self.lanes.close(lane, now)
        if self.end.established and not self.handshake.transport_up:
            self._session.end(reason, now)

    # --- bytes and time -------------------------------------------------------------------------------------------

    def next_datagram(self, *, now: float, lane: int = LANE_ZMQ) -> bytes | None:
        """The next bytes for the lane, or None if nothing may or need be sent now."""
        end = self.end
        try:
            if self.taking.fresh:
                self.taking.hand_on(now)
            if lane == LANE_ZMQ and self.handshake.speaks:
                if (said := self.handshake.next_datagram(now)) is not None:
                    return said
                if self.handshake.greeting:
                    end.dirty = False
                    return None
            state = self.lanes.by_id.get(lane)
            if not end.established or state is None or not state.up:
                end.dirty = False
                return None
            if state.flight.next_number >= framing.MAX_PACKET_NUMBER:
                self.handshake.renew(now)
                return self.next_datagram(now=now, lane=lane)
            return self.plane.next_datagram(state, now)
        except Exception as error:  # noqa: BLE001  (what was taken for the datagram is given back; the session ends)
            self.failed(error, now=now)
            return None

    def receive(self, data: framing.Datagram, *, now: float, lane: int = LANE_ZMQ) -> None:
        """One datagram from the lane. Raises WireError or VersionError for bytes no honest peer sends; the session has
        ended then, as it has after an error of ours, of which the owner is told (`on_fault`)."""
        self.heard_s = now
        self.heard_bytes += len(data)
        try:
            if data[:4] == self.end.data_prefix and framing.HEADER_BYTES <= len(data) <= framing.MAX_DATAGRAM_BYTES:
                state = self.lanes.by_id.get(lane)
                if state is not None:
                    number, stamp_us = NUMBER_AND_STAMP.unpack_from(data, 4)
                    self.reading.receive(state, number, stamp_us, data, now)
            else:
                if self._unreadable is not None:
                    error, self._unreadable = self._unreadable, None
                    raise error
                self.handshake.receive(bytes(data), lane, now)
        except RemoteError:
            self.handshake.abort("what it sent could not be read", now)
            raise
        except Exception as error:  # noqa: BLE001  (the one place for errors of ours while a datagram is read)
            self.failed(error, now=now)

    def next_deadline(self, lane: int = LANE_ZMQ) -> float | None:
        """When to call `handle_timeout` and `next_datagram` at the latest, if nothing else happens."""
        deadline_s, read_due_s = self._lane_deadline(lane), self.reading.due_s
        if read_due_s is None or (deadline_s is not None and deadline_s < read_due_s):
            return deadline_s
        return read_due_s

    def _lane_deadline(self, lane: int) -> float | None:
        state, established = self.lanes.by_id.get(lane), self.end.established
        if lane != LANE_ZMQ:
            return self.plane.deadline_s(state) if established and state is not None else None
        hello_due_s = self.handshake.hello_due_s
        if hello_due_s is not None and self.handshake.transport_up:
            return min(hello_due_s, self.housekeeping.due_s)
        if established and state is not None and state.up:
            return self.plane.deadline_s(state)
        return self.housekeeping.due_s

    def handle_timeout(self, *, now: float, lane: int = LANE_ZMQ) -> None:
        """Time has passed for the lane: to be called at `next_deadline`, and harmless before."""
        end = self.end
        try:
            if self.taking.fresh:
                self.taking.hand_on(now)
            if self.reading.due_s is not None and now >= self.reading.due_s:
                self.reading.read_on(now)
            state = self.lanes.by_id.get(lane)
            greets = lane == LANE_ZMQ and self.handshake.hello_due_s
            if end.established and state is not None and state.up and not greets:
                self.plane.handle_timeout(state, now)
            elif lane == LANE_ZMQ and now >= self.housekeeping.due_s:
                end.now = now
                self.housekeeping.sweep(now)
        except RemoteError as unreadable:
            self._unreadable = unreadable
            self.handshake.abort(f"what it sent could not be read: {unreadable}", now)
        except Exception as error:  # noqa: BLE001  (as in `receive`)
            self.failed(error, now=now)
        end.dirty = True

    def definition_known(self, digest: str, *, now: float) -> None:
        """A text arrived from elsewhere: pass it on if this peer is waiting for it."""
        self._control_reader.definition_known(digest, now)

    # --- views ----------------------------------------------------------------------------------------------------

    def encode_with(self, coder: Coder) -> None:
        """Encode the bodies of all channels that are opened from now on."""
        self.sender.encode_with(coder, lambda: self.lanes.lane.estimator.rate_bps)

    def close_streams(self) -> None:
        """The link is given up: its incoming streams are gone for good."""
        self.taking.close()
        self.texts.close()

    @property
    def peer(self) -> ClientName:
        """The name of the other end."""
        return self.end.peer

    @property
    def established(self) -> bool:
        """Whether there is a session."""
        return self.end.established

    @property
    def moved(self) -> bool:
        """Whether the peer has ended the session because it goes on at another relay."""
        return self.handshake.moved

    @property
    def dirty(self) -> bool:
        """Whether something may be sendable: the owner should poll `next_datagram`."""
        return self.end.dirty

    @property
    def now(self) -> float:
        """The time of the call under way, for handlers that are told without it."""
        return self.end.now

    @property
    def lane(self) -> Lane:
        """The lane that carries data now."""
        return self.lanes.lane

    @property
    def deaf(self) -> bool:
        """Whether more waits to be told than any peer leaves behind that reads what it is told."""
        return self.control.deaf(len(self.sender.channels))

    def observe(self, *, now: float) -> LinkView:
        """The link as it is now. Costs the same however many streams there are."""
        return view.observe(self.end, self.lanes, self.receiver, now)

    def topics(self) -> tuple[TopicView, ...]:
        """Every stream that is open towards the peer."""
        return view.topics(self.sender.channels.values())

    @property
    def counters(self) -> Mapping[TopicName, SendCounters]:
        """What was offered and what became of it, by topic. Counters go on counting: do not write to them."""
        return self.sender.ledger.topics

    def queued(self) -> dict[str, tuple[int, int]]:
        """Messages and bytes that wait for the lane, by class label. Looks at every stream."""
        return self.sender.queued()

    def held(self) -> dict[TopicName, Held]:
        """Messages that wait and that are in flight, by the topic of the stream. Looks at every message."""
        return view.held(self.sender.channels.values())

    def each_topic(self) -> Iterator[Counted]:
        """Every topic that is counted, each looked at when it is asked for: it adds up by itself."""
        by_topic: dict[TopicName, list[OutChannel]] = {}
        for channel in self.sender.channels.values():
            by_topic.setdefault(channel.stream.id.topic, []).append(channel)
        for topic, counters in tuple(self.counters.items()):
            channels = by_topic.get(topic, [])
            held = view.held(channels).get(topic)
            yield Counted(counters, view.topics(channels), Held(0, 0) if held is None else held)

    def offered(self) -> list[StreamInfo]:
        """Our streams that are open towards the peer."""
        return [channel.stream for channel in self.sender.channels.values()]

    def undelivered(self) -> Iterator[Undelivered]:
        """Every message that the peer is not known to have."""
        return view.undelivered(self.sender.channels.values())

    def sending(self, stream: StreamId, *, now: float) -> Sending | None:
        """How a stream stands that is open towards the peer; None: it is not. Changes nothing."""
        channel = self.outgoing.by_stream.get(stream)
        if channel is None:
            return None
        return Sending(channel.wanted, channel.counters, self.plane.holds.standing(channel, now))

    def arriving(self) -> list[StreamInfo]:
        """The peer's streams, as far as they are known here."""
        return [incoming.stream for incoming in self.taking.streams.values()]

    @property
    def rtt_s(self) -> float:
        """The round trip of the empty path where it is known, else the smoothed one; 0: neither is."""
        return view.rtt_s(self.lanes)

    def apply(self, settings: LinkSettings, *, now: float) -> None:
        """Set what may be set while the link runs. Idempotent; what waits or is under way is left as it is."""
        view.apply(settings, self.sender, self.lanes, now)

    def watch_arrivals(self, told: Callable[[TopicSpec, Message, float], None] | None) -> None:
        """Have `told` called when the peer has a message whole, with what holds for its topic and with the time. It is
        called while a datagram is read. None: nobody."""
        self.plane.on_arrived = told

    def snapshot(self) -> dict[str, object]:
        """State for /api/link; None where a value is not known yet."""
        return {
            **self.observe(now=self.end.now).to_json(),
            **self.lanes.lane.estimator.snapshot(),
            "queue": {label: {"messages": cell[0], "bytes": cell[1]} for label, cell in self.queued().items()},
        }

    def validate(self) -> None:
        """Internal consistency, for tests. Raises AssertionError with what does not add up."""

        def check(ok: bool, text: str) -> None:
            assert ok, f"{self.end.name}->{self.end.peer}: {text}"

        self.sender.validate(check)
        self.taking.validate(check)
        self.lanes.validate(check)
        self.texts.validate()
        held_bytes = self.taking.held_bytes + self.control.incoming.held_bytes
        check(self.reassembly.held_bytes == held_bytes, "reassembly bytes do not add up")
        check(len(self.outgoing.by_stream) == len(self.sender.channels), "channel tables differ")
