"""Files of several relays on one fabric, in one folder: keys for the clients, certificates between the relays.

A client's file names its relays with `at`, one of them, or `several`, a list; keys of clients are made with `admit`.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from sern_core.vocabulary.types import ClientName
from sern_tools.harness.files import Content, relay_content, write
from sern_tools.keygen import write_pair
from sern_tools.keygen_fabric import make_fabric
from sern_tools.ports import HOST, free_ports

CERTIFICATES: Final = "fabric"
"""The folder of the certificates."""
CLIENTS: Final = "clients"


class FabricFiles:
    """Makes the keys and certificates of the relays of these `names`, in `directory`. Every two of them have a
    connection; with `routers`, external ones, all are at those instead, whose certificates are made as well. One relay
    alone has no fabric.

    `tls` False: neither encrypted nor checked, as it may be on one machine. Errors are those of `make_fabric`.
    """

    def __init__(self, directory: Path, names: Sequence[str], *, routers: Sequence[str] = (), tls: bool = True) -> None:
        self.directory = directory
        self.names = tuple(names)
        self._routers = tuple(routers)
        self._tls = tls
        if tls and len(names) > 1:
            make_fabric([*names, *routers], out=directory / CERTIFICATES)
        protocol = "tls" if tls else "tcp"
        ports = iter(free_ports(2 * len(names) + len(routers)))
        self.endpoints = {name: f"tcp://{HOST}:{next(ports)}" for name in names}
        """Where clients connect."""
        self.locators = {name: f"{protocol}/{HOST}:{next(ports)}" for name in (*names, *routers)}
        """Where other relays connect, or, of routers, all relays."""
        (directory / CLIENTS).mkdir(exist_ok=True)
        for name in names:
            write_pair(ClientName(name), directory, directory, replace=True)

    def admit(self, clients: Iterable[str]) -> None:
        """Make the keys of clients; every relay knows them."""
        for name in clients:
            write_pair(ClientName(name), self.directory, self.directory / CLIENTS, replace=True)

    def relay(self, name: str, **sections: Any) -> Path:
        """NAME.yaml; `sections` as in `relay_content`."""
        if len(self.names) > 1:
            sections["fabric"] = self._connections(name) | sections.get("fabric", {})
        own = {"name": name, "secret_key_file": f"{name}.key"} | sections.pop("relay", {})
        content = relay_content(self.endpoints[name], relay=own, **sections)
        return write(self.directory, name, content)

    def _connections(self, name: str) -> Content:
        others = [other for other in self.names if other != name]
        found: Content = {"relays": others}
        if self._tls:
            found["certificates"] = CERTIFICATES
        if self._routers:
            return found | {"external": True, "peers": [self.locators[router] for router in self._routers]}
        place = self.names.index(name)
        if place + 1 < len(self.names):
            found["listen"] = [self.locators[name]]
        if place:
            found["peers"] = [self.locators[other] for other in self.names[:place]]
        return found

    def at(self, name: str) -> Content:
        """The section `relay` of a client that is at that one alone, as far as it is about the relay."""
        return {"endpoint": self.endpoints[name], "server_key_file": f"{name}.pub"}

    def several(self, content: Content, names: Iterable[str], **failover: float) -> Content:
        """A client's file with a list of relays, the preferred one first, in place of its relay. `failover`: keys of
        that section."""
        relay = content["relay"]
        rest: Content = {key: value for key, value in content.items() if key != "relay"}
        return rest | {"relays": [relay | self.at(name) for name in names], "failover": failover}


def reached(log: str) -> set[str]:
    """The relays with which the relay that wrote this log has a session."""
    found: set[str] = set()
    for line in log.splitlines():
        before, said, rest = line.partition("connected to the relay ")
        if said:
            (found.discard if before.endswith("not ") else found.add)(rest.split(":")[0].strip())
    return found
