"""What a site wants, as envelopes."""

from typing import Any

from sern_core.link.control_stream import ControlStream
from sern_core.link.end import End
from sern_core.site.subscription import Subscription
from sern_core.stream.in_stream import Reassembly
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing
from sern_core.wire.announce import MAX_STRINGS


class Session:
    """The control stream of a session that is there, and what was said over it."""

    def __init__(self) -> None:
        end = End(
            name=ClientName("site"), boot=1, peer=ClientName("relay"), initiator=True, towards_relay=True,
            params=LinkParams(), trace=DecisionTrace(enabled=False), now=0.0,
        )  # fmt: skip
        end.established = True
        self.control = ControlStream(end, Reassembly(2**20, end.params.limits), lambda _message: None)

    @property
    def said(self) -> list[tuple[framing.Envelope, bytes]]:
        return [framing.decode_control(out.message.body) for out in self.control.out.queue]


def subscribed(patterns: tuple[str, ...], known: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    session = Session()
    subscription = Subscription(session.control)
    subscription.patterns = patterns
    subscription.send(0.0, [ClientName(name) for name in known])
    return [envelope for envelope, _ in session.said]


def test_few_patterns_go_in_one_envelope_that_is_the_last() -> None:
    assert subscribed(("/a/.*", "/b/.*")) == [
        {"t": "subscribe", "patterns": ["/a/.*", "/b/.*"], "more": False, "peers": True, "keys": True}
    ]
    assert subscribed(()) == [{"t": "subscribe", "patterns": [], "more": False, "peers": True, "keys": True}]


def test_many_and_long_ones_go_in_several_whole_and_in_order() -> None:
    for patterns in (
        tuple(f"/robot{number}/.*" for number in range(3 * MAX_STRINGS + 1)),
        tuple(f"/{'x' * 900}{number}" for number in range(20)),
    ):
        parts = subscribed(patterns)
        assert tuple(pattern for part in parts for pattern in part["patterns"]) == patterns
        assert [part["more"] for part in parts] == [True] * (len(parts) - 1) + [False]
        assert all(len(part["patterns"]) <= MAX_STRINGS for part in parts) and len(parts) > 1


def test_who_is_asked_after_goes_first() -> None:
    first, last = subscribed(("/a",), ("robot1", "robot2"))
    assert first == {"t": "subscribe", "patterns": [], "more": True, "known": ["robot1", "robot2"]}
    assert last["patterns"] == ["/a"] and not last["more"]
