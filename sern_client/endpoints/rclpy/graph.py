"""What there is in a domain, as rclpy tells it when it is asked: publishers and services that are of this site.

What a SERN endpoint's node publishes or serves came over a link and is not of this site. It is known by its enclave,
and nodes of ours by their names. A publisher whose node is not known yet (discovery tells its name a moment later than
its topics) is waited for.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from sern_client.endpoints.base import GUARD_SUFFIX
from sern_client.endpoints.rclpy import qos
from sern_client.endpoints.rclpy.domain import ENCLAVE, Domain
from sern_client.endpoints.rclpy.qos import Offer
from sern_core.vocabulary.types import TopicName

if TYPE_CHECKING:
    from rclpy.topic_endpoint_info import TopicEndpointInfo

UNKNOWN_NODES: Final = frozenset({"_NODE_NAME_UNKNOWN_", ""})
"""What rclpy calls nodes whose names it does not know yet."""
MAX_UNKNOWN_LOOKS: Final = 8
"""For how many looks in a row a topic waits for unknown nodes. A writer that is of no node never gets one."""
EVERY: Final = 4
"""One look in so many asks for a topic that has as many publishers as before."""

_HASH: Final = re.compile(r"RIHS01_(?!0{64})[0-9a-f]{64}")
"""Nodes of before Iron do not say the hash of their types."""


@dataclass(frozen=True, slots=True)
class Publisher:
    """One of a topic, of this site."""

    node: str
    type_name: str
    type_hash: str
    offer: Offer


@dataclass(slots=True)
class Publishers:
    """Those of one topic. `bridged`: nodes of other SERN endpoints that publish it too. `unknown`: somebody publishes
    it whose node is not known yet."""

    here: list[Publisher] = field(default_factory=list)
    bridged: list[str] = field(default_factory=list)
    unknown: bool = False


class Graph:
    """Asks; `look` first, which finds out whose nodes are whose."""

    def __init__(self, domain: Domain, *, node_name: str, accept_bridged: bool) -> None:
        self._domain = domain
        self._node_name = node_name
        self._accept_bridged = accept_bridged
        self._nodes: list[tuple[str, str, str]] = []
        self._looks = 0
        self._counts: dict[str, int] = {}
        self._unknown: dict[str, int] = {}

    def look(self) -> None:
        self._looks += 1
        self._nodes = sorted(self._domain.node.get_node_names_and_namespaces_with_enclaves())

    @property
    def nodes(self) -> list[tuple[str, str, str]]:
        """Name, namespace and enclave of each."""
        return self._nodes

    # --- topics -----------------------------------------------------------------------------------------------------

    def topics(self) -> dict[TopicName, list[str]]:
        """Types by topic, those that only we publish among them."""
        found = self._domain.node.get_topic_names_and_types()
        names = {name for name, _ in found}
        for known in (self._counts, self._unknown):
            for gone in known.keys() - names:
                del known[gone]
        return {TopicName(name): types for name, types in found}

    def may_differ(self, name: TopicName) -> bool:
        """Whether a topic's publishers are to be asked for: each costs some time."""
        count = self._domain.node.count_publishers(name)
        changed = self._counts.get(name) != count or name in self._unknown
        self._counts[name] = count
        return changed or (self._looks + len(name)) % EVERY == 0  # not all of them at once

    def publishers(self, name: TopicName) -> Publishers:
        found = Publishers()
        bridged = self._bridged()
        for info in self._domain.node.get_publishers_info_by_topic(name):
            if self._ours(info.node_name, info.node_namespace):
                continue
            if info.node_name in UNKNOWN_NODES and self._waits(name):
                found.unknown = True
            elif (info.node_name, info.node_namespace) not in bridged:
                found.here.append(_publisher(info))
            elif not info.node_name.endswith(GUARD_SUFFIX):  # which publishes a stop command, if anything
                found.bridged.append(_full(info.node_name, info.node_namespace))
        if found.unknown:
            self._unknown[name] = self._unknown.get(name, 0) + 1
        return found

    def subscribers(self, name: TopicName, type_name: str) -> list[Offer]:
        """What each subscriber of a topic with this type asks for, ours among them."""
        infos = self._domain.node.get_subscriptions_info_by_topic(name)
        return [qos.read(info.qos_profile) for info in infos if info.topic_type == type_name]

    def _waits(self, name: TopicName) -> bool:
        return self._unknown.get(name, 0) < MAX_UNKNOWN_LOOKS

    # --- services ---------------------------------------------------------------------------------------------------

    def services(self) -> tuple[dict[TopicName, dict[str, str]], set[str]]:
        """The services of this site, each with its types and a node that serves it with that; and the names of all
        services of which a node is known: discovery tells that a moment later than the services."""
        bridged = self._bridged()
        found: dict[TopicName, dict[str, str]] = {}
        named: set[str] = set()
        for name, namespace, _ in self._nodes:
            if name in UNKNOWN_NODES:
                continue
            of_node = self._services_of(name, namespace)
            named.update(service for service, _ in of_node)
            if self._ours(name, namespace) or (name, namespace) in bridged:
                continue
            for service, types in of_node:
                for type_name in types:
                    found.setdefault(TopicName(service), {}).setdefault(type_name, _full(name, namespace))
        return found, named

    def _services_of(self, name: str, namespace: str) -> Sequence[tuple[str, list[str]]]:
        from rclpy.node import NodeNameNonExistentError

        try:
            return self._domain.node.get_service_names_and_types_by_node(name, namespace)
        except NodeNameNonExistentError:  # it went since we looked
            return ()

    # --- whose ------------------------------------------------------------------------------------------------------

    def _bridged(self) -> set[tuple[str, str]]:
        """The nodes of other SERN endpoints."""
        if self._accept_bridged:
            return set()
        return {(name, namespace) for name, namespace, enclave in self._nodes if enclave == ENCLAVE}

    def _ours(self, name: str, namespace: str) -> bool:
        return namespace == "/" and name in {self._node_name, self._node_name + GUARD_SUFFIX}


def _publisher(info: "TopicEndpointInfo") -> Publisher:
    type_hash = str(info.topic_type_hash)
    return Publisher(
        node=_full(info.node_name, info.node_namespace),
        type_name=info.topic_type,
        type_hash=type_hash if _HASH.fullmatch(type_hash) else "",
        offer=qos.read(info.qos_profile),
    )


def _full(name: str, namespace: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"
