"""Two relays on one fabric, as processes: keys for the clients, certificates between the relays."""

import json
from pathlib import Path
from typing import Any, Final

from sern_core.vocabulary.types import ClientName
from sern_tools.harness.files import relay_content, write
from sern_tools.keygen import write_pair
from sern_tools.keygen_fabric import make_fabric
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab, Process

RELAYS: Final = ("relay1", "relay2")


class TwoRelays:
    """The files of two relays. A client is at the one of the two whose address it has."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        make_fabric(RELAYS, out=lab.directory / "fabric")
        fabric_port, *ports = free_ports(3)
        self._between = f"tls/{HOST}:{fabric_port}"
        self.endpoints = {name: f"tcp://{HOST}:{port}" for name, port in zip(RELAYS, ports, strict=True)}
        for name in RELAYS:
            write_pair(ClientName(name), lab.directory, lab.directory, replace=True)

    def relay(self, name: str, **sections: Any) -> Process:
        (other,) = (each for each in RELAYS if each != name)
        where = {"listen": [self._between]} if name == RELAYS[0] else {"peers": [self._between]}
        fabric = {**where, "relays": [other], "certificates": "fabric"}
        said: dict[str, Any] = {"http": {"listen": f"{HOST}:{free_ports(1)[0]}"}, "summary": f"{name}.summary.json"}
        relay = {"name": name, "secret_key_file": f"{name}.key"}
        content = relay_content(self.endpoints[name], fabric=fabric, relay=relay, **said, **sections)
        return self.lab.process(write(self.lab.directory, name, content))

    def at(self, relay: str) -> dict[str, str]:
        """`relay` in the file of a client that is at that one."""
        return {"endpoint": self.endpoints[relay], "server_key_file": f"{relay}.pub"}

    def with_both(self, file: Path, *, first: str) -> Path:
        """The client's file with a list of both relays, `first` the preferred one, in place of its relay."""
        content = json.loads(file.read_text())
        relay = content.pop("relay")
        order = sorted(RELAYS, key=lambda name: name != first)
        content["relays"] = [relay | self.at(name) for name in order]
        content["failover"] = {"failover_s": 1.0, "return_s": 3600.0}
        return write(self.lab.directory, file.stem, content)
