"""The bounds and times that the guides name are those of the code."""

import re
from pathlib import Path
from typing import Final

import pytest

from sern_client import latest
from sern_client.action_conversion import cancelling, goals, server_for_ros1, server_for_ros2
from sern_client.endpoints.common import first_messages
from sern_client.endpoints.ros1 import Ros1Options
from sern_client.endpoints.ros1 import first_messages as ros1_first_messages
from sern_core.link import control_stream, definitions
from sern_core.objects.object_limits import ObjectLimits
from sern_core.relay import absent, access, draining, far_objects, feed_owners, interest, peer_objects, routing
from sern_core.site import peers
from sern_core.stream import decoding, drop_reports, in_stream, latched, prices
from sern_core.vocabulary import ledger
from sern_core.vocabulary.limits import LIMITS
from sern_core.wire import numbering
from sern_relay import server, transforms
from sern_runtime import feed_inflow, feed_subscriptions, priority_paths
from sern_runtime.config.relay import RelaySection, ReplaySection

ROOT: Final = Path(__file__).resolve().parents[2]
ROUTING, OBJECTS = interest.RoutingLimits(), ObjectLimits()


def nbytes(count: int) -> str:
    """Bytes as the guides write them."""
    for unit, name in ((2**20, "MiB"), (2**10, "KiB")):
        if count % unit == 0:
            return f"{count // unit} {name}"
    raise ValueError(count)


def default(section: type[RelaySection] | type[ReplaySection], key: str) -> int:
    return int(section.model_fields[key].default)


BOUNDS: Final[dict[str, tuple[str, ...]]] = {
    "messages that wait for a client": (
        nbytes(access.DEFAULT_QUEUE_BYTES),
        f"{prices.CLIENT_OVERHEAD_BYTES} bytes a message",
    ),
    "half-received and waiting": (f"{in_stream.PARTIAL_IDLE_S:g} s without a fragment",),
    "latched messages for late joiners": (
        nbytes(default(ReplaySection, "cache_bytes")),
        f"{latched.MAX_REPLAY_MESSAGES:,} of a stream",
    ),
    "streams announced": (f"{ROUTING.max_streams:,} ",),
    "patterns and names subscribed to": (f"{ROUTING.max_patterns} and {ROUTING.max_exact:,}",),
    "parts of an unfinished subscription": (
        f"{ROUTING.max_exact:,} patterns",
        f"{LIMITS.required:,} names",
    ),
    "definitions (": (
        nbytes(LIMITS.peer_definition_bytes),
        f"{definitions.MAX_DEFINITIONS:,} texts",
        f"{definitions.LINGERING_TEXTS} texts ({nbytes(definitions.LINGERING_BYTES)})",
    ),
    "definitions asked for": (f"{definitions.MAX_PEER_DEFINITIONS:,} that nobody",),
    "reports of drops": (
        f"{LIMITS.kept_reports:,} runs",
        f"above {LIMITS.reports:,} runs",
        f"for {drop_reports.UNREAD_S:g} s",
    ),
    "control messages to a client": (
        f"{LIMITS.unacked:,} answers",
        f"{nbytes(control_stream.MAX_TOLD_BYTES)} + {nbytes(control_stream.MAX_TOLD_CHANNEL_BYTES)} a channel",
    ),
    "objects (": (
        f"{OBJECTS.max_objects_per_owner:,};",
        f"{nbytes(OBJECTS.max_bytes_per_owner)}, of {nbytes(OBJECTS.max_total_bytes)} in all",
    ),
    "objects of clients of another relay": (
        f"{far_objects.PEER_LIMITS.max_objects:,}; {nbytes(far_objects.PEER_BYTES)}; "
        f"texts {nbytes(far_objects.PEER_LIMITS.max_texts_bytes)}; "
        f"the registry holds {nbytes(far_objects.PEER_BYTES)} more",
    ),
    "values that another relay asks for": (f"{peer_objects.MAX_PEER_WANTS} kinds and patterns",),
    "names under which another relay publishes": (f"| {feed_owners.MAX_OWNERS} |",),
    "looks at objects of other relays": (f"| {peer_objects.MAX_LOOKS} |",),
    "large values of objects": (f"{nbytes(OBJECTS.max_held_per_owner)}, of {nbytes(OBJECTS.max_held_bytes)} in all",),
    "transforms as objects": (f"{transforms.MAX_PAIRS:,} pairs", f"{transforms.MAX_WAITING} messages"),
    "clients that are waited for": (f"{absent.MAX_ABSENT_CLIENTS:,};", f"{LIMITS.absent_topics:,} each"),
    "boots of a client": (f"| {routing.RETIRED_BOOTS} |",),
    "numbers of streams": (f"{numbering.MAX_ENDED:,},",),
    "counters by topic": (f"{ledger.MAX_TOPICS:,} ",),
    "decisions of the access rules": (f"{access.CACHE_ENTRIES:,} ",),
    "bodies that are being decoded": (nbytes(decoding.MAX_WAITING_BYTES),),
    "connections, half-open ones": (f"{default(RelaySection, 'max_connections')} |",),
    "connections of one client": (f"{server.MAX_PORTS}; {priority_paths.CONNECTIONS} |",),
    "connections of the plain feed": (f"{feed_inflow.MAX_CONNECTIONS} |",),
    "latest values at a client": (f"{latest.MAX_TOPICS:,} streams", f"{latest.MAX_VALUE_BYTES // 1024} kB each"),
    "goals of an action of the other ROS": (
        f"{goals.MAX_LIVE} under way, {goals.MAX_GOALS} in all; results {nbytes(goals.MAX_RESULT_BYTES)}",
        f"{server_for_ros2.KEEP_S:g} s after",
        f"{server_for_ros1.KEEP_S:g} s where",
    ),
}
"""What the rows of the table in docs/operations.md say, by their beginning."""
TIMES: Final = {
    "docs/ros2-dds.md": (
        f"{first_messages.FIRST_MESSAGES_S:g} s at most",
        f"For {first_messages.LEARN_S:g} s after its start",
    ),
    "docs/ros1.md": (
        f"for {ros1_first_messages.FIRST_MESSAGES_S:g} s at most",
        f"`poll_hz`, {1 / Ros1Options('http://localhost:1', 'localhost', 'x').poll_hz:g} s",
    ),
    "docs/operations.md": (
        f"`replay.resume_s`, {default(ReplaySection, 'resume_s') // 60} minutes",
        f"of more than {peers.MAX_GIVEN_UP} such clients",
        f"than {LIMITS.draining} of them or {nbytes(draining.MAX_DRAINING_BYTES)}",
        f"A goal that its server keeps pending* for {server_for_ros2.PENDING_S:g} s",
        f"sent again for {cancelling.CANCEL_S / 60:g} minutes",
    ),
}


@pytest.mark.parametrize("beginning", BOUNDS)
def test_what_is_kept_is_bounded_as_the_table_says(beginning: str) -> None:
    section = (ROOT / "docs/operations.md").read_text().partition("## What is kept, and how much\n")[2]
    (row,) = [line for line in section.splitlines() if line.startswith(f"| {beginning}")]
    plain = row.replace("`", "")
    assert [bound for bound in BOUNDS[beginning] if not re.search(rf"(?<![\d,]){re.escape(bound)}", plain)] == [], row


@pytest.mark.parametrize("guide", TIMES)
def test_times_that_a_guide_names_are_those_of_the_code(guide: str) -> None:
    text = " ".join((ROOT / guide).read_text().split())
    assert [said for said in TIMES[guide] if said not in text] == []


def test_feeds_subscriptions_are_bounded_as_the_table_says() -> None:
    text = (ROOT / "docs/operations.md").read_text()
    assert f"each its length and {feed_subscriptions.ENTRY_BYTES} bytes" in text
    assert f"| role | {nbytes(feed_subscriptions.ROLE_BYTES)} |" in text
    assert f"| connection | {feed_subscriptions.KEPT_BYTES // 1024} kB |" in text
