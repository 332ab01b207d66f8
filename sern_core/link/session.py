"""A session of one end of a hop, begun and ended in every part. Pure.

`Handshake` says when. What survives a session stays with its part: queues, retained reliable messages, delivered
counts. What is in flight goes back to where it waits.
"""

from sern_core.link.answers import Answers
from sern_core.link.control_stream import ControlStream
from sern_core.link.definitions import PeerDefinitions
from sern_core.link.end import End
from sern_core.link.events import Events
from sern_core.link.lane_set import LaneSet
from sern_core.link.name_lists import NameLists
from sern_core.link.reading import Reading
from sern_core.link.sender import Sender
from sern_core.link.streams_in import StreamsIn
from sern_core.link.streams_out import StreamsOut
from sern_core.stream.in_stream import Reassembly
from sern_core.vocabulary.trace import LINK, TraceEvent
from sern_core.wire import framing


class Session:
    """The one session that there may be. `establish`, then `begin`; `end` is harmless without one."""

    def __init__(
        self,
        end: End,
        lanes: LaneSet,
        control: ControlStream,
        sender: Sender,
        outgoing: StreamsOut,
        taking: StreamsIn,
        answers: Answers,
        texts: PeerDefinitions,
        name_lists: NameLists,
        reassembly: Reassembly,
        reading: Reading,
        events: Events,
    ) -> None:
        self._end = end
        self._lanes = lanes
        self._control = control
        self._sender = sender
        self._outgoing = outgoing
        self._taking = taking
        self._answers = answers
        self._texts = texts
        self._name_lists = name_lists
        self._reassembly = reassembly
        self._reading = reading
        self._events = events

    def establish(self, peer_boot: int) -> None:
        """The handshake with that process is through."""
        end = self._end
        end.resumed = end.peer_boot == peer_boot
        if not end.resumed:
            for channel in self._sender.channels.values():
                channel.peer_restarted()
            self._lanes.forget_clock()
        end.peer_boot = peer_boot
        end.established = True
        end.data_prefix = bytes((framing.MAGIC, end.version, framing.Kind.DATA, end.tag))

    def begin(self, now: float) -> None:
        """Begin what was established: everything is announced again. May raise what the owner raises."""
        end = self._end
        self._lanes.begin(now)
        end.up_since_s = now
        self._taking.watermarks.clear()
        self._control.begin()
        end.trace.record(now, LINK, TraceEvent.LINK_UP, peer=end.peer)
        try:
            self._begin_streams(now)
        except Exception:  # goes on to whoever called; only the state is put right here
            end.peer_boot = None  # the owner may not have begun: to it the next session is the first with that peer
            raise

    def _begin_streams(self, now: float) -> None:
        self._texts.peer = self._end.peer
        self._texts.begin()
        self._answers.begin()
        self._name_lists.begin()
        self._outgoing.forget_announced()
        self._taking.begin(resumed=self._end.resumed, now=now)
        self._events.up(now=now)
        self._outgoing.begin(now)
        self._control.send({"t": "synced", "batch": True}, now=now)

    def end(self, reason: str, now: float) -> None:
        """End the session there is, if any, and let go of what belongs to it."""
        end = self._end
        end.now = now
        self._taking.hand_on(now)
        self._lanes.recall_all(now)
        self._taking.leave()
        self._reading.leave()
        self._reassembly.behind.pop(self._control.incoming, None)
        had_datagrams = self._lanes.leave()
        if not end.established:
            return
        end.established = False
        end.data_prefix = b""
        if had_datagrams:
            self._events.lane_closed()
        for channel in self._sender.channels.values():
            channel.ready = False
            self._sender.refresh(channel, now)
        end.trace.record(now, LINK, TraceEvent.LINK_DOWN, peer=end.peer, reason=reason)
        self._taking.forget_gone()
        self._events.down(reason, now=now)

    def kept_messages(self) -> int:
        """How many messages are kept for the peer."""
        return sum(channel.kept for channel in self._sender.channels.values())
