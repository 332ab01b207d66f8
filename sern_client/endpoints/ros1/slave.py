"""The node API that the master, other nodes and the tools call (wiki.ros.org/ROS/Slave_API).

Every method answers (code, text, value): 1 done, 0 it failed, -1 the caller made a mistake.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Protocol

MAX_INT: Final = 2**31 - 1
"""XML-RPC integers have 32 bits; a counter that is beyond stays here."""

Answer = tuple[int, str, Any]


@dataclass(frozen=True, slots=True)
class BusLink:
    """One connection of the node, for the tools. `direction`: `i` in, `o` out."""

    id: int
    peer: str
    direction: str
    topic: str
    sent_bytes: int
    received_bytes: int
    messages: int
    dropped: int


class Node(Protocol):
    """What the API asks of the node behind it. Names are those of the master."""

    def bus_links(self) -> list[BusLink]: ...

    def subscribed(self) -> list[tuple[str, str]]:
        """(topic, type)."""

    def published(self) -> list[tuple[str, str]]:
        """(topic, type)."""

    def tcpros_address(self) -> tuple[str, int]: ...

    def publishers_changed(self, topic: str, uris: list[str]) -> None: ...

    def asks_for(self, topic: str, caller: str) -> None:
        """A node is about to be told where to connect for a topic that is published here."""
        ...

    def told_to_shut_down(self, why: str) -> None: ...


class SlaveApi:
    """`dispatch` is what an `XmlRpcServer` serves."""

    def __init__(self, node: Node, master_uri: str) -> None:
        self._node = node
        self._master_uri = master_uri
        self._methods: dict[str, tuple[int, Callable[..., Answer]]] = {  # arguments beside the caller, who comes first
            "getBusStats": (0, self._bus_stats),
            "getBusInfo": (0, self._bus_info),
            "getMasterUri": (0, lambda _caller: (1, "", self._master_uri)),
            "getName": (0, lambda _caller: (0, "not told", "")),
            "getPid": (0, lambda _caller: (1, "", os.getpid())),
            "getSubscriptions": (0, lambda _caller: (1, "subscriptions", [list(pair) for pair in node.subscribed()])),
            "getPublications": (0, lambda _caller: (1, "publications", [list(pair) for pair in node.published()])),
            "paramUpdate": (2, lambda _caller, _key, _value: (1, "not subscribed to parameters", 0)),
            "publisherUpdate": (2, self._publisher_update),
            "requestTopic": (2, self._request_topic),
            "shutdown": (-1, self._shutdown),
        }

    def dispatch(self, method: str, params: tuple[Any, ...]) -> Answer:
        """KeyError for a method that no node has."""
        count, call = self._methods[method]
        if not params or not isinstance(params[0], str):
            return -1, f"{method}: the first parameter is the caller's name", 0
        if count >= 0 and len(params) != count + 1:
            return -1, f"{method}: {count + 1} parameters, not {len(params)}", 0
        return call(*params)

    def _publisher_update(self, _caller: str, topic: Any, uris: Any) -> Answer:
        if not isinstance(topic, str) or not isinstance(uris, list) or not all(isinstance(uri, str) for uri in uris):
            return -1, "publisherUpdate: caller, topic and a list of URIs", 0
        self._node.publishers_changed(topic, uris)
        return 1, "", 0

    def _request_topic(self, caller: str, topic: Any, protocols: Any) -> Answer:
        if not isinstance(topic, str) or not isinstance(protocols, list):
            return -1, "requestTopic: caller, topic and a list of protocols", 0
        if topic not in {name for name, _ in self._node.published()}:
            return 0, f"not a publisher of [{topic[:200]}]", 0
        if not any(isinstance(protocol, list) and protocol[:1] == ["TCPROS"] for protocol in protocols):
            return 0, "no supported protocol: TCPROS only", 0
        self._node.asks_for(topic, caller)
        host, port = self._node.tcpros_address()
        return 1, f"ready on {host}:{port}", ["TCPROS", host, port]

    def _shutdown(self, _caller: str, *why: Any) -> Answer:
        self._node.told_to_shut_down(str(why[0])[:200] if why else "")
        return 1, "shutdown", 0

    def _bus_info(self, _caller: str) -> Answer:
        rows = [
            [
                link.id, link.peer, link.direction, "TCPROS", link.topic, True,
                f"TCPROS connection, {link.messages} messages, {link.dropped} dropped",
            ]
            for link in self._node.bus_links()
        ]  # fmt: skip
        return 1, "bus info", rows

    def _bus_stats(self, _caller: str) -> Answer:
        published: dict[str, list[list[Any]]] = {}
        subscribed: list[list[Any]] = []
        totals: dict[str, int] = {}
        for link in self._node.bus_links():
            if link.direction == "o":
                row = [link.id, min(link.sent_bytes, MAX_INT), min(link.messages, MAX_INT), True]
                published.setdefault(link.topic, []).append(row)
                totals[link.topic] = min(totals.get(link.topic, 0) + link.sent_bytes, MAX_INT)
            else:
                row = [link.id, min(link.received_bytes, MAX_INT), min(link.dropped, MAX_INT), True]
                subscribed.append([link.topic, row])
        return 1, "bus stats", [[[t, totals[t], rows] for t, rows in published.items()], subscribed, [0, 0, 0]]
