"""What the peer says in control messages, each to the part that it is for. Pure."""

from collections.abc import Callable
from dataclasses import replace

from sern_core.link.answers import Answers
from sern_core.link.control_stream import ControlStream
from sern_core.link.definitions import PeerDefinitions
from sern_core.link.end import End
from sern_core.link.events import Events
from sern_core.link.name_lists import NameLists
from sern_core.link.sender import Sender
from sern_core.link.streams_in import StreamsIn
from sern_core.link.streams_out import StreamsOut
from sern_core.vocabulary.message import Message
from sern_core.wire import framing
from sern_core.wire.announce import decode_announcement, decode_want


class ControlReader:
    """Reads control messages in their turn. `answered` is told how many messages one of them has provoked."""

    def __init__(
        self,
        end: End,
        control: ControlStream,
        sender: Sender,
        outgoing: StreamsOut,
        taking: StreamsIn,
        answers: Answers,
        texts: PeerDefinitions,
        name_lists: NameLists,
        owner: Events,
        *,
        answered: Callable[[int], None],
    ) -> None:
        self._end = end
        self._control = control
        self._sender = sender
        self._outgoing = outgoing
        self._taking = taking
        self._answers = answers
        self._texts = texts
        self._name_lists = name_lists
        self._owner = owner
        self._answered = answered

    def read(self, message: Message) -> None:
        """Do what a message asks for. Raises WireError for what no honest peer says."""
        now = self._end.now
        envelope, attachment = self._control.decode(message, now)
        kind = framing.take_str(envelope, "t", max_length=16)
        before = self._control.out.next_seq
        self.handle(kind, envelope, attachment, now)
        said = self._control.out.next_seq - before
        # Reports of drops are repeated at an announcement: ours to say, not an answer, which comes later.
        self._answered(1 if kind == "announce" else said)

    def handle(self, kind: str, envelope: framing.Envelope, attachment: bytes, now: float) -> None:
        """Hand a message to the part it is for; what the link does not know is for its owner."""
        if kind == "announce":
            announcement = decode_announcement(envelope)
            key = ("announce", announcement.channel_id)
            required = self._name_lists.add(key, announcement.required, more=announcement.more, peer=self._end.peer)
            if required is not None:
                self._taking.announced(replace(announcement, required=required), now)
        elif kind == "want":
            self._outgoing.answered(decode_want(envelope), now)
        elif kind in ("refuse", "dropped"):
            channel = self._sender.channels.get(framing.take_int(envelope, "ch", high=0xFFFF))
            if channel is None:
                return  # closed meanwhile
            if kind == "dropped":
                self._outgoing.reported(channel, envelope)
            else:
                self._outgoing.refused(channel, envelope, now)
        elif kind in ("first", "retract"):
            channel_id = framing.take_int(envelope, "ch", high=0xFFFF)
            incoming = self._taking.incoming.get(channel_id)
            if incoming is None:
                return
            if kind == "first":
                incoming.known = True  # had it been nobody's before, it would have been announced again
                self._taking.skip(incoming, framing.take_int(envelope, "seq", low=1, high=framing.MAX_SEQ), now)
            else:
                self._taking.retract(incoming, now)
        elif kind == "synced":
            self._answers.batches(framing.take_bool(envelope, "batch"))
            self._taking.synced(now)
        elif kind == "need":
            digest = framing.take_str(envelope, "dh", max_length=64)
            self._define(digest, self._texts.asked(digest), now)
        elif kind == "define":
            digest = framing.take_str(envelope, "dh", max_length=64)
            if self._texts.came(digest, attachment):
                self._owner.definition(digest, now=now)
        else:
            self._owner.control(envelope, attachment, now=now)

    def definition_known(self, digest: str, now: float) -> None:
        """A text arrived from elsewhere: pass it on if this peer is waiting for it."""
        self._define(digest, self._texts.known(digest), now)

    def _define(self, digest: str, text: str | None, now: float) -> None:
        if text is not None:
            self._control.send({"t": "define", "dh": digest}, text.encode(), now=now)
