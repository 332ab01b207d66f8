"""An external router of a fabric: `python -m benchmarks.fabric.router SPEC` (JSON, the fields of `Router`).

zenohd is not in PyPI: this is the same router in a process of its own, with the rules that docs/fabric.md names.
"""

import json
import signal
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sern_core.vocabulary.types import ClientName
from sern_runtime.config.fabric import CA_FILE, CertificateFiles, certificate_file, key_file
from sern_runtime.fabric.zenoh_settings import FabricOptions, access_control, settings
from sern_tools.harness.fabric import CERTIFICATES, FabricFiles


@dataclass(frozen=True)
class Router:
    """It connects to `peers`. `relays` and `routers` may take part: routers are believed. `directory` has the
    certificates."""

    name: str
    listen: str
    peers: tuple[str, ...]
    relays: tuple[str, ...]
    routers: tuple[str, ...]
    directory: str

    @classmethod
    def of(cls, files: FabricFiles, name: str, routers: tuple[str, ...]) -> "Router":
        """That of this name; each connects to those before it."""
        before = tuple(files.locators[other] for other in routers[: routers.index(name)])
        return cls(name, files.locators[name], before, files.names, routers, str(files.directory / CERTIFICATES))

    def command(self) -> list[str]:
        """What follows `python`."""
        return ["-m", "benchmarks.fabric.router", json.dumps(asdict(self))]


def configuration(router: Router) -> dict[str, Any]:
    """What zenoh is told, by key."""
    folder = Path(router.directory)
    files = CertificateFiles(folder / CA_FILE, folder / certificate_file(router.name), folder / key_file(router.name))
    options = FabricOptions(
        name=ClientName(router.name),
        boot=1,
        listen=(router.listen,),
        peers=tuple(router.peers),
        certificates=files,
        external=True,
    )
    rules = access_control(ClientName("*"), [ClientName(relay) for relay in router.relays])
    rules["rules"].append({"id": "routers", "permission": "allow", "flows": ["ingress"],
                           "messages": rules["rules"][0]["messages"], "key_exprs": ["**"]})  # fmt: skip
    rules["subjects"].append({"id": "routers", "cert_common_names": list(router.routers)})
    rules["policies"].append({"rules": ["routers"], "subjects": ["routers"]})
    never = {"connect/timeout_ms": -1, "connect/exit_on_failure": False}
    return {**settings(options), **never, "mode": "router", "access_control": rules}


def main() -> None:
    import zenoh

    router = Router(**json.loads(sys.argv[1]))
    config = zenoh.Config()
    for key, value in configuration(router).items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        signal.pause()


if __name__ == "__main__":
    main()
