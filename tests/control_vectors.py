"""The golden vectors of control messages: each kind as one side says it, in an envelope."""

from typing import Any, Final

from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import (
    DROP_CODES,
    ClientName,
    DropReason,
    Durability,
    Encoding,
    PriorityClass,
    Reliability,
    TopicName,
)
from sern_core.wire.announce import Announcement, definition_hash, encode_announcement

Vector = dict[str, Any]
DEFINITION: Final = "std_msgs/Header header\nfloat64[] ranges\n"
A_KEY: Final = "rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7"
ANOTHER_KEY: Final = "Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID"


def _control(name: str, what: str, envelope: Vector, attachment: str = "") -> Vector:
    return {"name": name, "what": what, "layer": "control", "envelope": envelope, "attachment": attachment}


def _announcement(*, kept: bool = False) -> Vector:
    identity = StreamId(ClientName("jackal1"), 2**63 - 1, TopicName("/jackal1/map"))
    info = TopicInfo(identity.topic, "nav_msgs/msg/OccupancyGrid", Encoding.CDR, "RIHS01_" + "0f" * 32)
    spec = TopicSpec(
        priority=PriorityClass.STATE,
        weight=3.0,
        durability=Durability.TRANSIENT_LOCAL,
        depth=2,
        lifespan_s=None,
        deadline_s=0.5,
        reliability=Reliability.RELIABLE if kept else Reliability.BEST_EFFORT,
        durable=kept,
    )
    stream = StreamInfo(identity, info, spec, {"frame": "map"})
    return encode_announcement(Announcement(3, stream, definition_hash(DEFINITION), 40, ("site1", "site2")))


def control_messages() -> list[Vector]:
    """The messages without their bytes."""
    digest = definition_hash(DEFINITION)
    return [
        _control("announce", "a stream on channel 3 of its sender", _announcement()),
        _control("announce-kept", "the same stream, reliable and kept on disk by its origin", _announcement(kept=True)),
        _control(
            "want", "channel 3 is wanted by two clients", {"t": "want", "ch": 3, "on": True, "owed": ["site1", "site2"]}
        ),
        _control(
            "want-part",
            "the first of several messages that name who is owed channel 3",
            {"t": "want", "ch": 3, "on": True, "owed": ["site1"], "more": True},
        ),
        _control(
            "want-many",
            "channels 3, 4, 5, 6 and 9 are wanted, and client site1 is owed them",
            {"t": "want", "ch": 3, "on": True, "owed": ["site1"], "chs": [4, 6, 9, 9]},
        ),
        _control(
            "want-difference",
            "channel 3 stays wanted: site3 is owed it as well, site2 no longer",
            {"t": "want", "ch": 3, "on": True, "add": ["site3"], "drop": ["site2"]},
        ),
        _control("want-not", "nobody wants channel 3", {"t": "want", "ch": 3, "on": False, "owed": []}),
        _control(
            "refuse-stream",
            "channel 3 is not accepted",
            {"t": "refuse", "ch": 3, "code": "forbidden", "why": "no rule"},
        ),
        _control("first", "nothing below seq 41 will come on channel 3", {"t": "first", "ch": 3, "seq": 41}),
        _control("retract", "the stream on channel 3 is gone", {"t": "retract", "ch": 3}),
        _control("synced", "all streams of the session are announced", {"t": "synced"}),
        _control(
            "synced-batch",
            "the same, and several channels may be answered at once",
            {"t": "synced", "batch": True},
        ),
        _control("need", "asks for a definition", {"t": "need", "dh": digest}),
        _control("define", "the definition, packed with zlib", {"t": "define", "dh": digest}, DEFINITION),
        _control(
            "dropped-run",
            "a later hop gave up seq 41, 42 and 43 of channel 3",
            {"t": "dropped", "ch": 3, "seq": 41, "code": DROP_CODES[DropReason.QUEUE_FULL], "to": "site1", "n": 3},
        ),
        _control(
            "dropped",
            "a later hop gave up seq 41 of channel 3",
            {"t": "dropped", "ch": 3, "seq": 41, "code": DROP_CODES[DropReason.RETENTION], "to": "site1"},
        ),
        _control(
            "subscribe",
            "the last part of a client's patterns",
            {"t": "subscribe", "patterns": ["/jackal1/.*", "/tf"], "more": False},
        ),
        _control(
            "subscribe-peers",
            "the same, and the client is to be told of its peers",
            {"t": "subscribe", "patterns": ["/jackal1/.*", "/tf"], "more": False, "peers": True},
        ),
        _control(
            "peers",
            "jackal1 has been there for a minute, jackal2 is lost for 2.5 s, and nothing of jackal3 is taken any more",
            {
                "t": "peers",
                "peers": [
                    {"name": "jackal1", "up": True, "for": 60.0, "lane": "udp", "rtt": 0.0625},
                    {"name": "jackal2", "up": False, "for": 2.5, "lane": "zmq"},
                    {"name": "jackal3"},
                ],
            },
        ),
        _control(
            "peers-moved",
            "jackal1 has gone to another relay",
            {"t": "peers", "peers": [{"name": "jackal1", "up": False, "for": 0.0, "lane": "udp", "moved": True}]},
        ),
        _control(
            "subscribe-known",
            "an earlier part, in which a client asks of two that it knows",
            {"t": "subscribe", "patterns": [], "more": True, "known": ["jackal2", "jackal3"]},
        ),
        _control(
            "peers-here",
            "nothing of three is taken: jackal2 is given up, jackal3 is here, and of jackal4 an earlier release tells",
            {
                "t": "peers",
                "peers": [
                    {"name": "jackal2", "here": False},
                    {"name": "jackal3", "here": True},
                    {"name": "jackal4"},
                ],
            },
        ),
        _control(
            "denied",
            "the client may not have a topic that it named",
            {"t": "denied", "topic": "/jackal2/map", "code": "forbidden", "why": "no access rule grants it"},
        ),
        _control(
            "denied-pattern",
            "the relay takes nothing of this subscription",
            {"t": "denied", "pattern": "/(a*)*", "code": "bad_pattern", "why": "it could take too long to match"},
        ),
        _control(
            "subscribe-keys",
            "and the client is to be told of the relay's keys as well, as clients of this release say it",
            {"t": "subscribe", "patterns": ["/jackal1/.*"], "more": False, "peers": True, "keys": True},
        ),
        _control(
            "keys",
            "the relay has a key, and another to come; it takes none of the client's",
            {"t": "keys", "relay": [A_KEY, ANOTHER_KEY], "takes": False, "key": "", "code": "", "why": ""},
        ),
        _control(
            "keys-refused",
            "a key that the client has offered is not taken",
            {
                "t": "keys",
                "relay": [A_KEY],
                "takes": False,
                "key": ANOTHER_KEY,
                "code": "forbidden",
                "why": "this relay takes no keys over the link",
            },
        ),
        _control(
            "key",
            "the client accepts both keys of its relay for good, and offers a further one of its own",
            {"t": "key", "relay": [A_KEY, ANOTHER_KEY], "kept": True, "key": A_KEY},
        ),
        _control(
            "here",
            "two clients have their latest session at this relay, the second after others elsewhere",
            {"t": "here", "clients": [["jackal1", 1], ["jackal2", 5]]},
        ),
        _control(
            "feeds",
            "what this relay publishes itself has one owner",
            {"t": "feeds", "owners": ["feed_unity"]},
        ),
        _control("left", "a client is given up by this relay", {"t": "left", "clients": ["jackal1"]}),
        _control(
            "claims",
            "one client has a name, many may write another, and of a third no client of this relay has it any more",
            {
                "t": "claims",
                "topics": [
                    ["/jackal1/odom", "jackal1", 1_790_000_000_000_000, False],
                    ["/tf", "jackal1", 1_790_000_000_000_001, True],
                    ["/jackal1/scan"],
                ],
                "whole": False,
            },
        ),
        _control("offer", "a name is free that another client had", {"t": "offer", "topic": "/jackal1/odom"}),
        _control(
            "again",
            "the channel of a stream is about to begin again, from an earlier message on",
            {"t": "again", "origin": "jackal1", "boot": 7, "topic": "/jackal1/log"},
        ),
        _control(
            "takes",
            "a client begins with a stream of another relay, and is to have it from a message on",
            {
                "t": "takes",
                "client": "site1",
                "origin": "jackal1",
                "boot": 7,
                "topic": "/jackal1/log",
                "next": 26,
                "begins": True,
            },
        ),
        _control(
            "owed",
            "a relay keeps a topic for a client of another",
            {"t": "owed", "client": "site1", "topic": "/jackal1/log"},
        ),
        _control(
            "parted",
            "the client does not want it",
            {"t": "parted", "client": "site1", "topic": "/jackal1/log"},
        ),
        _control(
            "go",
            "a client that has gone over gets all of a topic that it lacks",
            {"t": "go", "client": "site1", "topic": "/jackal1/log"},
        ),
        _control(
            "released",
            "nothing of a topic needs to be kept for the client any more",
            {"t": "released", "client": "site1", "topic": "/jackal1/log"},
        ),
        _control(
            "rules",
            "this relay has the access rules of that hash, as the other one has",
            {"t": "rules", "hash": "4f53cda18c2baa0c0354bb5f9a3ecbe5"},
        ),
        _control(
            "rules-whole",
            "the access rules of this relay, of which the other does not say that it has the same: none, here",
            {"t": "rules", "hash": "4f53cda18c2baa0c0354bb5f9a3ecbe5"},
            "[]",
        ),
        _control(
            "revoked",
            "two keys were revoked at a relay, with the second the last one that jackal1 had there",
            {
                "t": "revoked",
                "keys": [["jackal1", A_KEY, 1_700_000_000.0, False], ["jackal1", ANOTHER_KEY, 1_700_000_000.5, True]],
            },
        ),
        _control(
            "lane-ask",
            "the client would use a datagram lane",
            {"t": "lane_ask", "ciphers": ["aes-256-gcm", "chacha20-poly1305"]},
        ),
        _control(
            "lane",
            "the keys of a datagram lane",
            {"t": "lane", "sid": 305419896, "secret": "5e" * 32, "cipher": "aes-256-gcm", "port": 5555},
        ),
        _control(
            "objects",
            "the objects that a client wants, and has",
            {
                "t": "objects",
                "kinds": ["robot", "topic"],
                "match": [".*", "/jackal1/.*"],
                "bare": 1,
                "since": 120,
                "epoch": 2**63 - 1,
            },
        ),
        _control(
            "objects-relays",
            "the first part of the objects whose values another relay wants",
            {
                "t": "objects",
                "kinds": ["", "obstacle"],
                "match": ["/jackal1/odom@.*", ".*"],
                "since": 0,
                "epoch": 0,
                "more": True,
            },
        ),
        _control("objects-lost", "the relay has nothing of the client's objects", {"t": "objects_lost"}),
        _control(
            "object-refused",
            "the relay did not take an object",
            {"t": "object_refused", "id": "zones/hall", "code": "not_owner", "why": "site owns it"},
        ),
    ]
