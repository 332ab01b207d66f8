"""From the endpoint sections of a client file to the endpoints themselves, for the baseline."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sern_client.endpoints.bag import BagEndpoint, BagOptions
from sern_client.endpoints.base import Endpoint
from sern_client.endpoints.composite import CompositeEndpoint
from sern_client.endpoints.synthetic import SyntheticEndpoint, SyntheticOptions
from sern_core.errors import ConfigError
from sern_runtime.config.client import ClientFile
from sern_runtime.config.load import Loaded

_PATHS = frozenset({"path", "cloud_files"})


def make_endpoint(loaded: Loaded[ClientFile]) -> Endpoint:
    """All endpoints of the file as one. ConfigError when one cannot be made."""
    kinds: dict[str, Callable[[dict[str, Any]], Endpoint]] = {
        "bag": lambda options: BagEndpoint(BagOptions(**options)),
        "synthetic": lambda options: SyntheticEndpoint(SyntheticOptions(**options)),
    }
    members = []
    for section in loaded.model.endpoints:
        if section.kind not in kinds:
            raise ConfigError(f"the baseline has no endpoint of kind {section.kind}", file=str(loaded.path))
        options = {name: getattr(section, name) for name in type(section).model_fields if name != "kind"}
        members.append(kinds[section.kind]({name: _resolved(loaded, name, value) for name, value in options.items()}))
    return CompositeEndpoint(members)


def _resolved(loaded: Loaded[ClientFile], name: str, value: Any) -> Any:
    if name not in _PATHS:
        return value
    return loaded.resolve(value) if isinstance(value, str) else tuple(Path(loaded.resolve(text)) for text in value)
