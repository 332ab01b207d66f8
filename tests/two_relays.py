"""Relays on one fabric, as processes: keys for the clients, certificates between the relays."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from sern_tools.harness.fabric import FabricFiles
from sern_tools.harness.files import write
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab, Process

RELAYS: Final = ("relay1", "relay2")


class TwoRelays:
    """The files of `names`, two relays or more. A client is at the one whose address it has."""

    def __init__(self, lab: Lab, names: Sequence[str] = RELAYS) -> None:
        self.lab = lab
        self.names = tuple(names)
        self.files = FabricFiles(lab.directory, names)

    def relay(self, name: str, *, router: str = "", **sections: Any) -> Process:
        """`router`: the address of an external one, in place of connections between them."""
        if router:
            sections["fabric"] = {"external": True, "peers": [router], "listen": []}
        said: dict[str, Any] = {"http": {"listen": f"{HOST}:{free_ports(1)[0]}"}, "summary": f"{name}.summary.json"}
        return self.lab.process(self.files.relay(name, **(said | sections)))

    def at(self, relay: str) -> dict[str, Any]:
        """`relay` in the file of a client that is at that one."""
        return self.files.at(relay)

    def with_both(self, file: Path, *, first: str) -> Path:
        """The client's file with a list of all relays, `first` the preferred one, in place of its relay."""
        order = sorted(self.names, key=lambda name: name != first)
        return self.going(file, *order)

    def going(self, file: Path, *order: str, failover_s: float = 1.0, return_s: float = 3600.0) -> Path:
        """The client's file with a list of relays in place of its one; by default it stays where it has gone."""
        times = {"failover_s": failover_s, "return_s": return_s}
        content = self.files.several(json.loads(file.read_text()), order, **times)
        return write(self.lab.directory, file.stem, content)
