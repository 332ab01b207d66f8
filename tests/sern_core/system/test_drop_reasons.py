"""Every reason for which a message may be dropped is made to happen in a test, has a code and is explained."""

import ast
from pathlib import Path
from typing import Final

from sern_core.vocabulary.ledger import OTHER_TOPIC
from sern_core.vocabulary.types import DROP_CODES, DropReason
from tests.fuzz.test_hostile_peer import Hostile, _piece, _whole
from tests.world import World

ROOT: Final = Path(__file__).resolve().parents[3]
PROOFS: Final = {
    DropReason.LIFESPAN: "stream/test_gate.py::test_what_is_held_back_has_a_lifespan_and_an_end",
    DropReason.SUPERSEDED: "stream/test_keep_last.py::test_keep_last_drops_the_oldest_that_has_not_begun",
    DropReason.RATE_CAP: "system/test_rate_cap.py::test_the_last_value_arrives_within_a_period",
    DropReason.UNWANTED: "system/test_reliable.py",
    DropReason.REFUSED: "system/test_reliable.py",
    DropReason.FORBIDDEN: "relay/test_hub.py",
    DropReason.RETENTION: ("stream/test_lapses.py::test_what_lapses_without_a_link_is_bounded_by_messages_not_by_runs"),
    DropReason.STALE: "system/test_service.py",
    DropReason.LOST: "stream/test_in_stream.py",
    DropReason.DUPLICATE: "stream/test_in_stream.py",
    DropReason.TOO_LARGE: "system/test_reliable.py",
    DropReason.UNKNOWN_CHANNEL: "system/test_drop_reasons.py::test_a_message_of_no_stream_is_counted_as_such",
    DropReason.REASSEMBLY: "stream/test_in_stream.py",
    DropReason.DISCONNECTED: "system/test_reliable.py",
    DropReason.SHUTDOWN: "stream/test_out_channel.py",
    DropReason.QUEUE_FULL: "relay/test_bound.py",
    DropReason.UNDECODABLE: "system/test_compression.py",
    DropReason.UNCONFIRMED: "stream/test_out_channel.py",
    DropReason.FAULT: (
        "system/test_faults.py::test_a_reliable_message_that_a_site_fails_at_is_reported_and_the_stream_goes_on"
    ),
    DropReason.STORAGE: "site/test_holding.py::test_what_was_lost_is_reported_to_its_origin_before_it_is_confirmed",
    DropReason.E_STOP: "system/test_commands.py",
    DropReason.NOT_HOLDER: "system/test_commands.py",
    DropReason.TOO_SLOW: "link/test_outlook.py::test_what_cannot_arrive_is_hardly_ever_begun",
}
"""Where each is made to happen and asserted."""


def asserted(path: Path, name: str, reason: DropReason) -> bool:
    """Whether a test function of the file asserts something with the reason in it."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_") and name in ("", node.name):
            text = ast.unparse(node)
            if f"DropReason.{reason.name}" in text and "assert" in text:
                return True
    return False


def test_every_reason_has_a_proof() -> None:
    assert PROOFS.keys() == set(DropReason)
    here = ROOT / "tests/sern_core"
    missing = [
        reason
        for reason, proof in PROOFS.items()
        if not asserted(here / proof.partition("::")[0], proof.partition("::")[2], reason)
    ]
    assert missing == []


def test_every_reason_is_explained_with_its_code() -> None:
    guide, wire = (ROOT / "docs/operations.md").read_text(), (ROOT / "schemas/wire.md").read_text()
    assert [reason for reason in DropReason if f"\n| `{reason}` |" not in guide] == []
    assert [reason for reason in DropReason if f"\n| {DROP_CODES[reason]} | `{reason}` |" not in wire] == []


def test_a_message_of_no_stream_is_counted_as_such() -> None:
    """Once a message, not once a fragment, where the guide says."""
    world = World()
    peer = Hostile(world, "mallory")
    peer.say(_whole(77, 1), _piece(77, 2, 0, 2), _piece(77, 2, 1, 2))
    received = world.relay.hub.received.topics[OTHER_TOPIC]
    assert received.by_reason[DropReason.UNKNOWN_CHANNEL] == 2 and received.delivered == 0
    assert world.relay.hub.links[peer.name].receiver.strays == 3
