"""Endpoints from sections: whose services are whose."""

import pytest
from pydantic import TypeAdapter

from sern_client.factory import services_elsewhere
from sern_runtime.config.endpoints import EndpointSection

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
