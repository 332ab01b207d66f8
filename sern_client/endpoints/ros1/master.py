"""The master's API as a node uses it, and its state as plain data."""

from typing import Any, Final, NamedTuple
from xmlrpc.client import Fault

from sern_client.endpoints.ros1.xmlrpc import CallError, XmlRpcClient, decode_call, value_of
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.names import name_problem

ANY: Final = "*"
"""The type or md5sum that fits every other."""

Table = dict[str, tuple[str, ...]]
"""Topic or service name to the names of its nodes."""


class SystemState(NamedTuple):
    """Who publishes, subscribes to and serves what, in the master's order."""

    publishers: Table
    subscribers: Table
    services: Table


class Master:
    """Calls of one node to one master. Every call raises UnreachableError while there is none, CallError for a no."""

    def __init__(self, uri: str, caller: str) -> None:
        self.uri = uri
        self.caller = caller
        self.caller_api = ""
        """The URI of our node API; set before anything is registered."""
        self._client = XmlRpcClient(uri)

    async def state(self) -> bytes:
        """The system state, undecoded: a state that is the same in every byte need not be read again."""
        return await self._client.request("getSystemState", self.caller)

    def read_state(self, answer: bytes) -> SystemState:
        """Decodes `state()`. Names that no ROS node could have are left out. CallError for nonsense."""
        value = value_of(answer, self.uri, "getSystemState")
        if not isinstance(value, list) or len(value) != 3:
            raise CallError(f"{self.uri}: getSystemState: not three lists")
        return SystemState(*(_table(part, self.uri) for part in value))

    async def node_uri(self, name: str) -> str:
        """The URI of a node's API. CallError when the master does not know the node."""
        return str(await self._client.call("lookupNode", self.caller, name))

    async def service_uri(self, name: str) -> str:
        """rosrpc://host:port of a service. CallError when there is none."""
        return str(await self._client.call("lookupService", self.caller, name))

    async def run_id(self) -> str:
        """What names one run of the master; empty where nobody set it."""
        answer = await self._client.request("getParam", self.caller, "/run_id")
        try:
            triple = decode_call(answer)[0][0]
        except (Fault, WireError, IndexError) as error:
            raise CallError(f"{self.uri}: getParam: {error}") from None
        return str(triple[2]) if isinstance(triple, list) and len(triple) == 3 and triple[0] == 1 else ""

    async def register_publisher(self, topic: str, type_name: str) -> None:
        await self._client.call("registerPublisher", self.caller, topic, type_name, self.caller_api)

    async def unregister_publisher(self, topic: str) -> None:
        await self._client.call("unregisterPublisher", self.caller, topic, self.caller_api)

    async def register_subscriber(self, topic: str, type_name: str) -> None:
        await self._client.call("registerSubscriber", self.caller, topic, type_name, self.caller_api)

    async def unregister_subscriber(self, topic: str) -> None:
        await self._client.call("unregisterSubscriber", self.caller, topic, self.caller_api)

    async def register_service(self, service: str, service_uri: str) -> None:
        await self._client.call("registerService", self.caller, service, service_uri, self.caller_api)

    async def unregister_service(self, service: str, service_uri: str) -> None:
        await self._client.call("unregisterService", self.caller, service, service_uri)

    def close(self) -> None:
        self._client.close()


def _table(part: Any, uri: str) -> Table:
    table: Table = {}
    for row in part if isinstance(part, list) else [part]:
        if not (isinstance(row, list) and len(row) == 2 and isinstance(row[0], str) and isinstance(row[1], list)):
            raise CallError(f"{uri}: getSystemState: a row is not (name, nodes)")
        if name_problem(row[0]) is None:
            table[row[0]] = tuple(node for node in row[1] if isinstance(node, str))
    return table
