"""What people look at is what comes over the link: relay, robot and a site with an endpoint at which somebody looks."""

from pathlib import Path
from typing import Any

import pytest

from sern_client import daemon as client_daemon
from sern_client.endpoints.base import Viewed
from sern_client.factory import make_endpoint
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import TopicName
from tests.bridges import FakeEndpoint, FakePublisher
from tests.daemons import Json, Lab
from tests.support import until

ODOM, IMU, MAP = TopicName("/robot1/odometry/filtered"), TopicName("/robot1/imu/data"), TopicName("/robot1/map")
ROBOT: Json = {"kind": "synthetic", "role": "robot", "encoding": "cdr", "topics": ["/odometry/filtered", "/imu/data"]}


class Viewer(FakeEndpoint):
    """Somebody who looks."""

    def __init__(self) -> None:
        super().__init__()
        self.viewed: Viewed | None = None
        self.offered: dict[TopicName, TopicInfo] = {}

    def use_viewed(self, viewed: Viewed) -> None:
        self.viewed = viewed

    def topic_offered(self, info: TopicInfo) -> None:
        self.offered[info.name] = info

    def topic_withdrawn(self, name: TopicName) -> None:
        del self.offered[name]

    def look(self, name: TopicName, *, wanted: bool = True) -> None:
        assert self.viewed is not None
        self.viewed.want(name, wanted)

    def at(self, name: TopicName) -> FakePublisher | None:
        """What publishes a topic here now."""
        return next((each for each in self.publishers if each.info.name == name and not each.closed), None)

    def age_s(self, name: TopicName) -> float | None:
        assert self.viewed is not None
        return next((news.age_s for news in self.viewed.topics() if news.name == name), None)


@pytest.fixture
def viewer(monkeypatch: pytest.MonkeyPatch) -> Viewer:
    """The endpoint of whoever is named `site`."""
    made, make = Viewer(), make_endpoint

    def made_or_viewer(loaded: Any) -> Any:
        return made if loaded.model.name == "site" else make(loaded)

    monkeypatch.setattr(client_daemon, "make_endpoint", made_or_viewer)
    return made


def site_file(lab: Lab, **sections: Any) -> Path:
    sections = {"client": {"namespace": "/"}, "on_demand": ["/robot1/.*"], **sections}
    return lab.client_file("site", {"kind": "record", "path": "unused"}, **sections)


async def test_a_topic_comes_while_somebody_looks_at_it(tmp_path: Path, viewer: Viewer) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        robot = await lab.connected(lab.client_file("robot1", ROBOT))
        site = await lab.connected(site_file(lab))
        await until(
            lambda: {ODOM, IMU} <= viewer.offered.keys() and viewer.offered[ODOM].definition, "both are offered"
        )
        info = viewer.offered[ODOM]
        assert (info.type_name, info.encoding) == ("nav_msgs/msg/Odometry", "cdr")
        assert "geometry_msgs/PoseWithCovariance" in info.definition and info.type_hash.startswith("RIHS01_")
        assert not viewer.publishers and not site.core.received.topics

        viewer.look(ODOM)
        viewer.look(TopicName("/robot1/not/there"))
        await until(lambda: (found := viewer.at(ODOM)) is not None and len(found.bodies) > 3, "it comes")
        assert viewer.at(IMU) is None, "what nobody looks at does not"
        assert viewer.age_s(ODOM) is not None and viewer.age_s(IMU) is None
        sent = {topic: counters.delivered for topic, counters in robot.core.link.counters.items()}
        assert sent[ODOM] > 0 and sent[IMU] == 0

        viewer.look(ODOM, wanted=False)
        await until(lambda: viewer.at(ODOM) is None, "and no longer")
        assert ODOM in viewer.offered, "it may be looked at again"
        viewer.look(ODOM)
        await until(lambda: viewer.at(ODOM) is not None, "again")
        robot.bridge.outbound.topic_removed(TopicName("/imu/data"))
        await until(lambda: IMU not in viewer.offered, "what is gone cannot be looked at")


async def test_what_is_looked_at_comes_again_after_a_robot_was_away(tmp_path: Path, viewer: Viewer) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        await lab.connected(site_file(lab))
        viewer.look(ODOM)  # before there is anything
        robot = await lab.connected(lab.client_file("robot1", ROBOT))
        await until(lambda: (found := viewer.at(ODOM)) is not None and found.bodies, "it comes when it is there")
        await lab.drop(robot)
        count = len(viewer.publishers)
        await lab.connected(lab.client_file("robot1", ROBOT))
        await until(lambda: len(viewer.publishers) > count or len(viewer.publishers[-1].bodies) > 20, "and again")
        assert viewer.viewed is not None and viewer.offered[ODOM].name == ODOM


async def test_what_the_file_subscribes_to_comes_whether_somebody_looks_or_not(tmp_path: Path, viewer: Viewer) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        await lab.connected(lab.client_file("robot1", ROBOT))
        await lab.connected(site_file(lab, subscribe=["/robot1/imu/.*"]))
        await until(lambda: (found := viewer.at(IMU)) is not None and found.bodies, "it comes")
        viewer.look(IMU)
        viewer.look(ODOM)
        await until(lambda: (found := viewer.at(ODOM)) is not None and found.bodies)
        viewer.look(IMU, wanted=False)
        viewer.look(ODOM, wanted=False)
        await until(lambda: viewer.at(ODOM) is None)
        assert viewer.at(IMU) is not None


async def test_what_may_not_be_had_is_not_offered(tmp_path: Path, viewer: Viewer) -> None:
    access = [{"client": "robot1", "publish": ["/robot1/.*"]}, {"client": "site", "subscribe": ["/robot1/imu/.*"]}]
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay(lab.relay_file(access=access))
        await lab.connected(lab.client_file("robot1", ROBOT))
        await lab.connected(site_file(lab))
        await until(lambda: IMU in viewer.offered)
        assert ODOM not in viewer.offered
