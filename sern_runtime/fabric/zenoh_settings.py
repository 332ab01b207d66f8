"""What zenoh is told: nothing but what is configured, and who may write which key. Imports nothing of zenoh.

Everything that finds peers by itself is off, as are shared memory (it went around the link on one host), multilink
and the space of administration. With certificates each relay lets others write by the common name of the certificate of
their connection alone: `h/SELF/THEIRS/*`, tokens that have their name, and a subscription to their own inbox.

Every two relays need a connection of their own, and a relay is there as long as that is: zenoh's mode is `peer`. As
routers they would pass each other's tokens and datagrams on, and the rules refuse what comes from another than its
source: with three relays and one connection cut, both ends went on seeing each other through the third, and nothing
arrived (measured).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sern_core.vocabulary.types import ClientName
from sern_core.wire.framing import MAX_DATAGRAM_BYTES, VERSIONS, Versions
from sern_runtime.config.fabric import LEASE_S, CertificateFiles
from sern_runtime.fabric.keys import RELAY_TOKENS, ROOT, inbox
from sern_runtime.fabric.port import PeerRelay

RETRY_FIRST_S: Final = 0.25
RETRY_MAX_S: Final = 4.0
"""Pauses between tries to reach a peer: each is twice the one before, within these two."""
ROUTER_S: Final = 3.0
"""How long one try to reach an external router takes: five round trips of a satellite's 600 ms."""
KEEP_ALIVES: Final = 3
"""In a lease, on a connection that is idle otherwise. Nothing is lost on it, so one of them would do that is not late.
They, coming and going, are most of what an idle fabric of 20 relays takes (measured)."""
WAIT_BEFORE_DROP_US: Final = 1000
"""How long a put may wait, and hold the event loop, for room in a full queue. 0 loses datagrams of an idle link: a
queue is also full while the thread that sends takes what is in it (measured: 3 of 200)."""
WHOLE_BYTES: Final = 65_000
"""The largest datagram that fits one of zenoh's batches (65,535 bytes) with its key and headers. A larger one goes in
pieces, each of which waits for room of its own."""
MAX_MESSAGE_BYTES: Final = 2 * MAX_DATAGRAM_BYTES
"""What a peer may have put together of pieces here; zenoh's default is a gigabyte."""
QUEUES: Final = (
    "control", "real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low", "background",
)  # fmt: skip
QUEUE_BATCHES: Final = 16
"""Batches that a queue holds, the most that zenoh takes. An express datagram has one for itself, however small: with
the 2 of its default, 143 of 200 datagrams that came ten at a time were lost on an idle link (measured)."""


@dataclass(frozen=True, slots=True)
class FabricOptions:
    """One relay's end of a fabric, checked: `sern_runtime.config.fabric` says what the parts mean."""

    name: ClientName
    boot: int
    rules: str = ""
    listen: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    relays: tuple[ClientName, ...] | None = None
    certificates: CertificateFiles | None = None
    external: bool = False
    lease_s: float = LEASE_S
    wire_versions: Versions = VERSIONS
    inbox_datagrams: int = 4096
    """Datagrams that may wait for the event loop; it takes them within a turn or two."""
    inbox_bytes: int = 64 * 2**20
    tokens: int = 100_000
    """Relays that are remembered."""

    @property
    def itself(self) -> PeerRelay:
        """What it says of itself."""
        return PeerRelay(self.name, self.boot, self.wire_versions, self.rules)


def settings(options: FabricOptions) -> Mapping[str, Any]:
    """Keys of zenoh's configuration, with values as JSON has them."""
    found: dict[str, Any] = {
        "mode": "client" if options.external else "peer",
        "listen/endpoints": [_everywhere(locator) for locator in options.listen],
        "connect/endpoints": list(options.peers),
        "listen/exit_on_failure": True,
        # A peer may come later than we do, and go. Zenoh's client opens no session before it has its router: it tries
        # once, and how often that is done is up to `zenoh_port`.
        "connect/timeout_ms": 0 if options.external else -1,
        "connect/exit_on_failure": options.external,
        "connect/retry": {
            "period_init_ms": round(1000 * RETRY_FIRST_S),
            "period_max_ms": round(1000 * RETRY_MAX_S),
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_links": 1,
        "transport/unicast/open_timeout": round(1000 * ROUTER_S) if options.external else 10_000,
        "transport/link/tx/lease": round(1000 * options.lease_s),
        "transport/link/tx/keep_alive": KEEP_ALIVES,
        "transport/link/tx/queue/size": dict.fromkeys(QUEUES, QUEUE_BATCHES),
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": WAIT_BEFORE_DROP_US,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": WAIT_BEFORE_DROP_US,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        "timestamping/enabled": False,
        "adminspace/enabled": False,
    }
    files = options.certificates
    if files is not None:
        # Whose a certificate is says its common name, wherever it answers: addresses are not in it.
        found["transport/link/protocols"] = ["tls"]
        found["transport/link/tls"] = {
            "root_ca_certificate": str(files.ca),
            "listen_certificate": str(files.certificate),
            "listen_private_key": str(files.key),
            "connect_certificate": str(files.certificate),
            "connect_private_key": str(files.key),
            "enable_mtls": True,
            "verify_name_on_connect": False,
            "close_link_on_expiration": True,
        }
        if not options.external:
            found["access_control"] = access_control(options.name, options.relays or ())
    else:
        found["transport/link/protocols"] = ["tcp"]
    return found


def _everywhere(locator: str) -> str:
    """`*` as zenoh has it: every address, of IPv6 as well as of IPv4."""
    protocol, _, address = locator.partition("/")
    return f"{protocol}/[::]{address[1:]}" if address.startswith("*") else locator


def access_control(own: ClientName, others: Sequence[ClientName]) -> dict[str, Any]:
    """Who may write what to this relay, by the common name of the certificate; nobody else anything."""
    outward = ["put", "declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "liveliness_token"]
    rules = [_rule("out", "egress", outward, [f"{ROOT}/**"])]
    subjects: list[dict[str, Any]] = [{"id": "all"}]
    policies = [{"rules": ["out"], "subjects": ["all"]}]
    for other in others:
        theirs = [
            _rule(f"put {other}", "ingress", ["put"], [f"{ROOT}/h/{own}/{other}/*"]),
            _rule(f"inbox {other}", "ingress", ["declare_subscriber"], [inbox(other)]),
            _rule(f"look {other}", "ingress", ["declare_liveliness_subscriber", "liveliness_query"], [RELAY_TOKENS]),
            _rule(f"tokens {other}", "ingress", ["liveliness_token"], [f"{ROOT}/relay/{other}/**"]),
        ]
        rules += theirs
        subjects.append({"id": other, "cert_common_names": [other]})
        policies.append({"rules": [rule["id"] for rule in theirs], "subjects": [other]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
