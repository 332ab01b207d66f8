"""Our node in the graph of a domain."""

import itertools
from typing import Any

from sern_client.endpoints.base import GUARD_SUFFIX
from sern_client.endpoints.zenoh import names
from sern_client.endpoints.zenoh.names import Entity, Kind, Qos
from sern_client.endpoints.zenoh.session import ZenohSession
from sern_core.vocabulary.types import TopicName


class Declared:
    """Something that others reach in our session, and its token in the graph."""

    def __init__(self, session: ZenohSession, thing: Any, token: Any) -> None:
        self._session = session
        self._thing = thing
        self._token = token

    def end(self) -> None:
        """Undeclare both, after what is still to be sent; once."""
        thing, token = self._thing, self._token

        def undeclare() -> None:
            try:
                thing.undeclare()
            finally:  # or the graph would name it for ever
                token.undeclare()

        self._session.put(undeclare, 0)


class Node:
    """What a session says of itself in the graph, once it is open."""

    def __init__(self, session: ZenohSession, domain: int, name: str, enclave: str) -> None:
        self.session = session
        self._domain = domain
        self._name = name
        self._enclave = enclave
        self._entities = itertools.count(1)
        self._zid = ""
        self._token: Any = None

    def join(self) -> None:
        self._zid = self.session.zid
        self._token = self._declare(names.node_token(self._domain, self._zid, self._name, self._enclave))

    @property
    def others(self) -> str:
        """The key of all tokens in the domain."""
        return f"{names.SPACE}/{self._domain}/**"

    def owns(self, entity: Entity) -> bool:
        """Whether it is of this client: declared through our zenoh session, or by the guard."""
        return entity.session == self._zid or entity.node == f"/{self._name}{GUARD_SUFFIX}"

    def key(self, name: TopicName, dds_name: str, type_hash: str) -> str:
        """What bodies of a topic or service are sent to."""
        return names.data_key(self._domain, name, dds_name, type_hash)

    def token(self, kind: Kind, name: TopicName, dds_name: str, type_hash: str, qos: Qos) -> Any:
        """Tell the others of an entity."""
        return self._declare(
            names.entity_token(
                self._domain, self._zid, next(self._entities), kind, self._name, self._enclave,
                name=name, dds_name=dds_name, type_hash=type_hash, qos=qos,
            )
        )  # fmt: skip

    def new_gid(self) -> bytes:
        """A new id for a publisher of ours."""
        return names.new_gid(self._enclave)

    def _declare(self, token: str) -> Any:
        return self.session.opened.liveliness().declare_token(token)
