"""Configuration files of a relay and its clients in one folder, with the keys that `keygen.make_keys` puts there.

`sections` go on top of what is there by default: `relay` and `client` key by key, any other section as a whole.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

RELAY: Final = "relay"
ALLOW_ALL: Final = ({"client": ".*", "publish": [".*"], "subscribe": [".*"]},)

Content = dict[str, Any]


def relay_content(*listen: str, secure: bool = True, **sections: Any) -> Content:
    """What a relay needs that listens there; who has a key may say and see everything. `secure`: with keys."""
    relay: Content = {"name": RELAY, "listen": list(listen)}
    relay |= {"secret_key_file": f"{RELAY}.key", "clients_dir": "clients"} if secure else {"insecure": True}
    return {"access": list(ALLOW_ALL), **sections, "relay": relay | sections.get("relay", {})}


def client_content(name: str, address: str, endpoint: object, *, secure: bool = True, **sections: Any) -> Content:
    """What a client needs of the relay at `address`."""
    relay: Content = {"endpoint": address}
    relay |= {"server_key_file": f"{RELAY}.pub", "secret_key_file": f"{name}.key"} if secure else {"insecure": True}
    return {
        **sections,
        "client": {"name": name} | sections.get("client", {}),
        "relay": relay | sections.get("relay", {}),
        "endpoint": endpoint,
    }


def write(directory: Path, name: str, content: Mapping[str, Any]) -> Path:
    """NAME.yaml; JSON is YAML."""
    path = directory / f"{name}.yaml"
    path.write_text(json.dumps(content, indent=1))
    return path
