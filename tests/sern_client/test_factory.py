"""Endpoints from sections: whose services are whose, and where actions of the other ROS are converted."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from sern_client.action_conversion.endpoint import ActionEndpoint
from sern_client.endpoints.composite import CompositeEndpoint
from sern_client.endpoints.ros1 import Ros1Endpoint
from sern_client.factory import make_endpoint, services_elsewhere
from sern_client.site import Site
from sern_core.topics.rules import RuleSet
from sern_runtime.config.client import load_client
from sern_runtime.config.endpoints import EndpointSection
from tests.daemons import Lab

_SECTIONS: TypeAdapter[list[EndpointSection]] = TypeAdapter(list[EndpointSection])


@pytest.mark.parametrize(
    ("sections", "elsewhere"),
    [
        ([{"kind": "dds"}, {"kind": "rclpy", "services_only": True}], [0]),
        ([{"kind": "rclpy", "services_only": True}, {"kind": "dds", "domain": 7}], [1]),
        ([{"kind": "rclpy", "domain": 7, "services_only": True}, {"kind": "dds"}], [1]),
        ([{"kind": "rclpy", "domain": 8, "services_only": True}, {"kind": "dds"}], []),
        ([{"kind": "dds"}, {"kind": "rclpy"}], []),
        ([{"kind": "zenoh"}, {"kind": "rclpy", "services_only": True}], []),
    ],
)
def test_services_of_a_domain_are_one_endpoints(
    monkeypatch: pytest.MonkeyPatch, sections: list[dict[str, object]], elsewhere: list[int]
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    assert services_elsewhere(_SECTIONS.validate_python(sections)) == elsewhere


ROS1 = {"kind": "ros1", "master_uri": "http://127.0.0.1:1"}
USED = {"use": [{"match": "/robot1/move_base", "timeout_s": 60}]}


def made(directory: Path, endpoint: object, **sections: Any) -> Any:
    return make_endpoint(load_client(Lab(directory, "site").client_file("site", endpoint, **sections)))


def test_actions_are_converted_where_some_are_used(tmp_path: Path) -> None:
    assert isinstance(made(tmp_path, ROS1), Ros1Endpoint)
    assert isinstance(made(tmp_path, ROS1, actions={"offer": [{"match": "/move_base"}]}), Ros1Endpoint)
    endpoint = made(tmp_path, ROS1, actions=USED)
    assert isinstance(endpoint, ActionEndpoint) and isinstance(endpoint.inner, Ros1Endpoint)
    (rule,) = endpoint._rules
    assert rule.match.fullmatch("/robot1/move_base") and rule.answer_s == 15.0
    site = Site(endpoint, RuleSet(), "/", kick=lambda: None)
    assert site.converter is endpoint.converter


def test_a_recording_beside_it_makes_no_difference(tmp_path: Path) -> None:
    endpoint = made(tmp_path, [ROS1, {"kind": "record", "path": "site.bag"}], actions=USED)
    assert isinstance(endpoint, ActionEndpoint) and isinstance(endpoint.inner, CompositeEndpoint)
    assert endpoint.converter is endpoint.inner.converter and len(endpoint.keepers) == 1


def test_where_nodes_of_both_are_none_are(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    pytest.importorskip("zenoh", reason="the library eclipse-zenoh is missing: pip install eclipse-zenoh")
    assert isinstance(made(tmp_path, [ROS1, {"kind": "zenoh"}], actions=USED), CompositeEndpoint)
    assert "no action is converted from one to the other" in caplog.text
    assert isinstance(made(tmp_path, {"kind": "record", "path": "site.bag"}).encoding, type(None))
