"""Sentences of decision traces, as a person reads them."""

from typing import Any

import pytest

from sern_core.vocabulary.trace import LINK, DecisionTrace, HoldReason, TraceEvent
from sern_core.vocabulary.types import DropReason, TopicName
from sern_runtime.watching.words import DROPS
from sern_tools.explain import story
from sern_tools.explain_story import ADVICE, NAMES, advice, held_because, in_short, lines, verdict

SCAN = TopicName("/scan")


def recorded(*steps: tuple[float, TraceEvent, int, dict[str, Any]]) -> list[dict[str, Any]]:
    trace = DecisionTrace()
    for now, event, seq, fields in steps:
        trace.record(now, LINK if event in (TraceEvent.LINK_UP, TraceEvent.CAPACITY) else SCAN, event, seq, **fields)
    return trace.to_json()


RELAY = {"peer": "relay"}
BEHIND = RELAY | {"reason": HoldReason.CLASS, "after": "/odom", "after_class": "control"}


def test_what_a_message_waited_for_and_what_became_of_it() -> None:
    records = recorded(
        (0.5, TraceEvent.LINK_UP, 0, RELAY),
        (1.0, TraceEvent.QUEUED, 7, RELAY | {"size_bytes": 3000}),
        (1.1, TraceEvent.HELD, 7, BEHIND),
        (1.4, TraceEvent.SENT, 7, RELAY | {"size_bytes": 3000}),
        (1.45, TraceEvent.LOST, 7, RELAY | {"fragments": 2}),
        (1.6, TraceEvent.SENT, 7, RELAY),
        (1.7, TraceEvent.ACKED, 7, RELAY),
    )
    told = list(lines(records, now_s=3.0, last=5))
    assert told[0].split() == ["2.5", "s", "link", "connected", "to", "relay"]
    assert told[1].split()[:4] == ["2.0", "s", "7", "3"]
    assert "waited 0.4 s (/odom (control) goes first), lost 2 fragments, which went again, arrived at relay" in told[1]
    assert told[1].endswith("after 0.7 s")
    assert advice(records, None) == ""


def test_a_restless_link_does_not_bury_a_quiet_topic() -> None:
    changes = [(1.0 + step, TraceEvent.CAPACITY, 0, RELAY | {"rate_bps": 1e6, "rtt_s": 0.05}) for step in range(20)]
    records = recorded(
        (0.5, TraceEvent.QUEUED, 1, RELAY),
        (0.6, TraceEvent.ACKED, 1, RELAY),
        *changes,
        (30.0, TraceEvent.QUEUED, 2, RELAY),
    )
    told = list(lines(records, now_s=31.0, last=4))
    assert [line.split()[2] for line in told] == ["1", "link", "link", "link", "link", "link", "2"]
    assert told[1].endswith("16 changes up to here (--last shows more)") and told[1].split()[0] == "15.0"


def test_a_message_that_waits_and_one_that_was_dropped_for_it() -> None:
    """A newer message inherits what its stream waits for, and neighbours that fared alike share a line."""
    records = recorded(
        (1.0, TraceEvent.QUEUED, 1, RELAY),
        (1.0, TraceEvent.HELD, 1, BEHIND),
        (1.2, TraceEvent.DROPPED, 1, RELAY | {"reason": DropReason.SUPERSEDED}),
        (1.2, TraceEvent.QUEUED, 2, RELAY),
        (1.4, TraceEvent.DROPPED, 2, RELAY | {"reason": DropReason.SUPERSEDED}),
        (1.4, TraceEvent.QUEUED, 3, RELAY),
    )
    told = list(lines(records, now_s=2.0, last=5))
    assert len(told) == 2
    assert "1-2" in told[0] and "2 messages in 0.2 s, the last: waited 0.2 s (/odom (control) goes first)" in told[0]
    assert told[0].endswith("dropped: a newer message took its place")
    assert told[1].endswith("waits: /odom (control) goes first")
    assert in_short(records) == (
        "of 3 messages 2 dropped (superseded), 1 waiting; those dropped had waited for: a more urgent class 2"
    )
    assert advice(records, None) == ADVICE[HoldReason.CLASS]
    assert verdict(records) == "message 3 waits: /odom (control) goes first"


def test_a_confirmation_is_of_all_before_it() -> None:
    records = recorded(
        (1.0, TraceEvent.QUEUED, 1, RELAY),
        (1.1, TraceEvent.SENT, 1, RELAY),
        (1.2, TraceEvent.QUEUED, 2, RELAY),
        (1.5, TraceEvent.CONFIRMED, 2, RELAY),
    )
    assert "2 messages" in next(lines(records, now_s=2.0, last=5))
    assert verdict(records).startswith("message 2 confirmed: everybody has it")


def test_what_arrives_is_told_apart_from_what_leaves() -> None:
    records = recorded(
        (1.0, TraceEvent.QUEUED, 1, RELAY),
        (1.1, TraceEvent.DELIVERED, 1, {"origin": "robot2", "age_s": 0.25}),
        (1.2, TraceEvent.LEASE_EXPIRED, 0, {"origin": "robot2", "after_s": 0.5}),
    )
    told = "\n".join(lines(records, now_s=2.0, last=5))
    assert "waits in its queue" in told and "arrived here from robot2, 0.2 s old" in told
    assert "no fresh command for 0.5 s: the stop command was published" in told


def test_every_reason_has_words() -> None:
    assert DROPS.keys() == set(DropReason) and NAMES.keys() == set(HoldReason)
    for reason in HoldReason:
        text = held_because({"reason": reason})
        assert len(text) > len(reason), "words, and not its name"
    assert all("\n" not in text for text in ADVICE.values())


@pytest.mark.parametrize("event", TraceEvent)
def test_every_event_can_be_told(event: TraceEvent) -> None:
    fields: dict[str, Any] = RELAY | {
        "reason": DropReason.LOST,
        "age_s": 0.1,
        "after_s": 1.0,
        "rate_bps": 1e6,
        "rtt_s": 0.1,
        "lane": "udp",
        "name": SCAN,
        "lifespan_s": 1.0,
    }
    fields = fields if event is not TraceEvent.HELD else RELAY | {"reason": HoldReason.WINDOW}
    fields = fields if event is not TraceEvent.RATE_CAPPED else RELAY | {"reason": HoldReason.RATE_CAP}
    told = list(lines(recorded((1.0, TraceEvent.QUEUED, 1, RELAY), (1.1, event, 1, fields)), now_s=2.0, last=5))
    assert told and all(line.strip() and "None" not in line for line in told)


def told_of(*, before: dict[str, Any] | None = None, **stream: Any) -> str:
    standing = {"waiting": 1, "under_way": 0, "seq": 3, "begun": False, "age_s": 0.4, "unsent_bytes": 10, "rank": 2}
    given = {
        "peer": "relay", "origin": "robot", "direction": "send", "up": True, "class": "state", "reliable": False,
        "latched": False, "depth": 1, "lifespan_s": 0.5, "max_rate_hz": None, "wanted": True, "offered": 3,
        "delivered": 1, "refused": 0, "dropped": {}, "standing": standing | BEHIND,
    } | stream  # fmt: skip
    answer = {"topic": "/scan", "now_s": 2.0, "steps": True, "streams": [given], "streams_left_out": 0, "records": []}
    earlier = None if before is None else answer | {"now_s": 1.5, "streams": [given | before]}
    return "\n".join(story(answer, last=5, before=earlier))


def test_a_rate_is_beside_each_total() -> None:
    text = " ".join(told_of(before={"offered": 1, "delivered": 0}, dropped={"lifespan": 1}).split())
    assert "of 3 offered 1 arrived; dropped: 1 lifespan; now 4.0/s offered, 2.0/s arrive, 0.0/s dropped" in text
    assert "offered, " not in told_of(before={"offered": 99})  # it began anew


def test_the_head_of_a_story_says_how_it_stands() -> None:
    text = told_of()
    assert text.startswith("/scan of robot, to relay: class state, best effort, the newest 1 kept, lifespan 0.5 s")
    assert "1 waits; message 3, 0.4 s old, waits: /odom (control) goes first (2 topics go" in text
    assert f"  to do     {ADVICE[HoldReason.CLASS]}" in text
    assert "nobody subscribes to it, so nothing of it is sent" in told_of(wanted=False)
    assert ADVICE[DropReason.UNWANTED][:40] in told_of(wanted=False)
    assert "there is no connection to relay; 1 waits" in told_of(up=False)
