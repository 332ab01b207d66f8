"""What is no action of the other ROS passes the endpoint between as if it were not there."""

from pathlib import Path

from sern_client.actions import STATUS_TYPE
from sern_client.endpoints.base import ServiceInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_services, ros_types
from tests.sern_client.action_conversion.nodes import ACTION, Site, ros1_topic


async def test_all_else_passes(tmp_path: Path) -> None:
    """Also actions of the nodes' own ROS, and services."""
    site = await Site(Encoding.ROS1, tmp_path).start()
    publisher = site.endpoint.advertise(ros1_topic("status", STATUS_TYPE))
    assert list(site.nodes.published) == [f"{ACTION}/status"]
    publisher.close()
    text = ros_services.resolve("std_srvs/srv/SetBool", "", Encoding.ROS1).text
    info = ServiceInfo(TopicName("/robot1/set"), "std_srvs/srv/SetBool", Encoding.ROS1, *reversed(text))

    async def handler(request: bytes) -> bytes:
        return request

    served = site.endpoint.serve(info, handler)
    assert list(site.nodes.served) == ["/robot1/set"]
    served.close()
    assert await site.endpoint.call(TopicName("/own"), b"!", timeout_s=1.0) == b"/own!"
    odometry = ros_types.topic_info("/robot1/odom", "nav_msgs/msg/Odometry", Encoding.ROS1)
    site.nodes.add(odometry)
    taken = site.endpoint.subscribe(odometry.name, lambda _body, _stamp_ns: True)
    site.endpoint.interest(odometry.name, False)
    assert site.events.infos == {odometry.name: odometry} and site.nodes.interests == {odometry.name: False}
    taken.close()
    assert site.endpoint.encoding is None and site.endpoint.drops == {}
    assert site.endpoint.keepers == [] and site.endpoint.viewers == []
