"""The configuration sections of the endpoints offer what the endpoints take, with the same defaults."""

import sys
from dataclasses import MISSING, Field, asdict, fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, get_type_hints

import pytest

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from sern_client.endpoints.bag import BagOptions
from sern_client.endpoints.dds.endpoint import DdsOptions
from sern_client.endpoints.foxglove.options import FoxgloveOptions
from sern_client.endpoints.jackal import JACKAL
from sern_client.endpoints.rclpy import RclpyOptions
from sern_client.endpoints.record import RecordOptions
from sern_client.endpoints.ros1 import Ros1Options
from sern_client.endpoints.synthetic import SyntheticOptions
from sern_client.endpoints.twin.options import RobotOptions, TwinOptions
from sern_client.endpoints.unity.options import UnityOptions
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_client.sections import make_section, options_of
from sern_core.vocabulary.errors import ConfigError
from sern_runtime.config import endpoints as sections
from sern_runtime.config.base import EndpointBase
from sern_runtime.config.endpoints import (
    MAX_SYNTHETIC_TOPICS,
    BagEndpoint,
    DdsEndpoint,
    RclpyEndpoint,
    RecordEndpoint,
    Ros1Endpoint,
    SyntheticEndpoint,
    ZenohEndpoint,
)
from sern_runtime.config.foxglove import FoxgloveEndpoint
from sern_runtime.config.twin import TwinEndpoint, TwinRobot, TwinView
from sern_runtime.config.unity import UnityEndpoint

PAIRS = [
    (BagEndpoint, BagOptions),
    (SyntheticEndpoint, SyntheticOptions),
    (RecordEndpoint, RecordOptions),
    (Ros1Endpoint, Ros1Options),
    (DdsEndpoint, DdsOptions),
    (ZenohEndpoint, ZenohOptions),
    (RclpyEndpoint, RclpyOptions),
    (TwinEndpoint, TwinOptions),
    (FoxgloveEndpoint, FoxgloveOptions),
    (UnityEndpoint, UnityOptions),
]
SAID_BY_NO_FILE = {"second", "publishes_only", "enclave", "as_node"}
OTHERWISE_BY_DEFAULT = {(DdsOptions, "domain")}
"""Which domain it is where the file says nothing, the environment says."""


def every(kind: Any) -> dict[str, Field[Any]]:
    """The fields of options and of the options in them."""
    found: dict[str, Field[Any]] = {}
    hints = get_type_hints(kind)
    for field in fields(kind):
        found |= every(hints[field.name]) if is_dataclass(hints[field.name]) else {field.name: field}
    return found


@pytest.mark.parametrize(("section", "options"), PAIRS, ids=lambda item: item.__name__)
def test_section_mirrors_options(section: type[EndpointBase], options: type[Any]) -> None:
    settings = {name: field for name, field in section.model_fields.items() if name != "kind"}
    known = every(options)
    assert set(settings) == known.keys() - SAID_BY_NO_FILE
    for name in settings.keys() - {name for kind, name in OTHERWISE_BY_DEFAULT if kind is options}:
        # What must be chosen in a file may have a default in code.
        if known[name].default is not MISSING and not settings[name].is_required():
            assert settings[name].default == known[name].default, name


def test_options_are_those_of_the_section() -> None:
    section = ZenohEndpoint(
        kind="zenoh", connect=("tcp/a:1",), config_file="session.json5", domain=7, type_paths=("one", "two")
    )
    made = options_of(ZenohOptions, section, Path("/folder").joinpath, second=True)
    assert asdict(made) == {
        "session": {
            "connect": ("tcp/a:1",), "listen": None, "config_file": Path("/folder/session.json5"), "second": True,
        },
        "domain": 7,
        "node_name": "sern",
        "type_paths": (Path("/folder/one"), Path("/folder/two")),
        "accept_bridged": False,
        "enclave": "/sern",
    }  # fmt: skip


@pytest.mark.parametrize(("section", "options"), PAIRS, ids=lambda item: item.__name__)
def test_every_key_of_a_section_reaches_the_options(section: type[EndpointBase], options: type[Any]) -> None:
    values: dict[str, Any] = {name: f"value of {name}" for name in section.model_fields}
    made = options_of(options, section.model_construct(**values), Path)
    found = asdict(made)
    found |= {key: value for inner in found.values() if isinstance(inner, dict) for key, value in inner.items()}
    for name in values.keys() - {"kind"}:
        assert found[name] in (values[name], Path(values[name])), name


def test_as_many_topics_as_the_robot_has() -> None:
    assert len(JACKAL) == MAX_SYNTHETIC_TOPICS


@pytest.mark.parametrize(("listen", "place"), [("127.0.0.1:8090", ("127.0.0.1", 8090)), ("[::1]:9", ("::1", 9))])
def test_the_view_of_a_twin(monkeypatch: pytest.MonkeyPatch, listen: str, place: tuple[str, int]) -> None:
    robot = TwinRobot(name="jackal1", pose="/jackal1/odom")
    section = TwinEndpoint(kind="twin", robots=(robot,), view=TwinView(listen=listen))
    monkeypatch.setitem(sys.modules, "viser", ModuleType("viser"))
    endpoint: Any = make_section(section, Path)
    assert endpoint.view is not None
    assert section.view is not None and section.view.place == place
    monkeypatch.setattr(sections, "installed", lambda package: False)
    with pytest.raises(ConfigError, match=r"needs viser: .* -m pip install 'sern\[viz\]'"):
        make_section(section, Path)


def test_robots_of_a_twin() -> None:
    assert {field.name for field in fields(RobotOptions)} == set(TwinRobot.model_fields)
    robot = TwinRobot(name="jackal1", pose="/jackal1/odom", plan="/jackal1/plan", max_speed_mps=1.5)
    endpoint: Any = make_section(TwinEndpoint(kind="twin", robots=(robot,)), Path)
    assert [twin.options for twin in endpoint.robots.values()] == [
        RobotOptions("jackal1", "/jackal1/odom", "/jackal1/plan", max_speed_mps=1.5)
    ]


def test_viewers_need_a_package_that_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sections, "installed", lambda package: False)
    with pytest.raises(ConfigError, match=r"foxglove needs foxglove-sdk: .* -m pip install foxglove-sdk"):
        make_section(FoxgloveEndpoint(kind="foxglove"), Path)
