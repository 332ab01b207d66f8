"""A robot that is gone is said at its site: real daemons, killed, and behind a link with far more than it carries."""

import signal
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

from sern_client.daemon import ClientDaemon
from sern_client.endpoints.synthetic import SyntheticEndpoint
from sern_core.vocabulary.types import ClientName
from sern_sim.models import LinkModel
from sern_tools.proxy import Route, ShapingProxy
from tests.daemons import HOST, Lab, Process, endpoint_of
from tests.support import until

ROBOT: dict[str, Any] = {"kind": "synthetic", "role": "robot", "topics": ["/pose"]}
SITE: dict[str, Any] = {"kind": "synthetic", "role": "operator", "command_rate_hz": 1.0}


def site_file(lab: Lab, name: str = "site", **sections: Any) -> Path:
    state = {"publish": True} | sections.pop("link_state", {})
    return lab.client_file(
        name, sections.pop("endpoint", SITE), client={"namespace": "/"}, subscribe=["/robot.*"], link_state=state,
        **sections,
    )  # fmt: skip


def status(site: ClientDaemon, peer: str) -> tuple[int, dict[str, str]] | None:
    """Level and values of the last message on /PEER/sern/link; None: there is none."""
    endpoint = endpoint_of(site, SyntheticEndpoint)
    message = endpoint.latest(f"/{peer}/sern/link")
    if message is None:
        return None
    return int(message.level), {pair.key: pair.value for pair in message.values}


def level(site: ClientDaemon, peer: str) -> int | None:
    found = status(site, peer)
    return None if found is None else found[0]


def connected(process: Process, peer: str) -> bool | None:
    rows = {row["peer"]: row["connected"] for row in process.json("/api/peers")}
    return rows.get(peer)


def gone(process: Process) -> list[str]:
    """Peers that the relay has lost. Where the own link is silent for a moment it is not known of any."""
    return [row["peer"] for row in process.json("/api/peers") if row["status"] == "gone"]


def is_ready(process: Process, words: str = "") -> bool:
    """Whether /readyz says yes, with these words."""
    code, line = process.get("/readyz")
    return code == 200 and words in line


async def test_a_robot_that_is_killed_is_gone_on_every_way_and_comes_back(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "robot2", "site") as lab:
        await lab.process(lab.relay_file()).ready()
        for name in ("robot1", "robot2"):
            lab.client_file(name, ROBOT)
        robot1, robot2 = (lab.process(tmp_path / f"{name}.yaml") for name in ("robot1", "robot2"))
        site = lab.process(site_file(lab))
        for process in (robot1, robot2, site):
            await process.ready()
        await site.until(lambda: connected(site, "robot1") and connected(site, "robot2"), "has both")
        age = 'sern_peer_age_seconds{peer="robot1"}'
        await site.until(lambda: age in site.get("/metrics")[1], "has heard it")
        robot1.kill()
        await site.until(lambda: gone(site) == ["robot1"], "says so, and of no other")
        await site.said("robot1 is gone")
        await site.until(
            lambda: is_ready(site, "1 of 2 peers away: robot1 is gone for"), "is ready, and says who is away"
        )
        told = ('sern_peer_connected{peer="robot1"} 0.0', 'sern_peer_connected{peer="robot2"} 1.0', age)

        def all_told() -> bool:
            metrics = site.get("/metrics")[1]
            return all(words in metrics for words in told)

        await site.until(all_told, "tells the metrics, too")
        lab.process(tmp_path / "robot1.yaml")
        await site.until(lambda: connected(site, "robot1"), "has it back")
        await site.said("robot1 is back after")
        await site.until(
            lambda: is_ready(site) and "peers away" not in site.get("/readyz")[1], "says nothing more of it"
        )


async def test_a_robot_that_is_given_up_is_shown_so_over_http_until_it_is_back(tmp_path: Path) -> None:
    """Also when the site has a new session in between."""
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = lab.process(lab.relay_file(replay={"resume_s": 1.0}))
        await relay.ready()
        robot = lab.process(lab.client_file("robot1", ROBOT))
        site = lab.process(site_file(lab))
        for process in (robot, site):
            await process.ready()

        def row() -> tuple[str, bool] | None:
            """Status, and whether it is given up."""
            rows = {row["peer"]: row for row in site.json("/api/peers")}
            return (rows["robot1"]["status"], rows["robot1"]["given_up"]) if "robot1" in rows else None

        await site.until(lambda: row() == ("connected", False), "has the robot")
        robot.kill()
        await site.until(lambda: row() == ("gone", True), "shows that it is given up")
        await site.said("robot1 is given up by the relay after")
        relay.kill()
        await site.until(lambda: row() == ("unknown", True), "has lost the relay")
        lab.process(tmp_path / "relay.yaml")
        await site.until(lambda: row() == ("gone", True), "has heard that it is still gone")
        await site.until(
            lambda: is_ready(site, "1 of 1 peers away: robot1 is gone for"), "is ready, and says who is away"
        )
        lab.process(tmp_path / "robot1.yaml")
        await site.until(lambda: row() == ("connected", False), "has it back")
        await site.said("robot1 is back after")


async def test_what_the_nodes_are_told_when_robot_and_relay_go(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = lab.process(lab.relay_file())
        await relay.ready()
        robot = lab.process(lab.client_file("robot1", ROBOT))
        site = await lab.connected(site_file(lab, link_state={"period_s": 0.1}))
        await until(lambda: level(site, "robot1") == 0, "it is there")

        def whole_way() -> bool:
            found = status(site, "robot1")
            assert found is not None
            values = found[1]
            return values["round_trip_to"] == "robot1" and values["age_s"] != "" and values["lane"] == "udp"

        await until(whole_way, "with round trip, age and lane")
        robot.kill()
        await until(lambda: level(site, "robot1") == 2, "it is gone")
        lab.process(tmp_path / "robot1.yaml")
        await until(lambda: level(site, "robot1") == 0, "it is back")
        relay.kill()
        await until(lambda: level(site, "robot1") == 3, "nobody knows")

        def age_s() -> float:
            found = status(site, "robot1")
            assert found is not None
            return float(found[1]["age_s"])

        before_s = age_s()
        await until(lambda: age_s() > before_s, "its age grows")
        own = endpoint_of(site, SyntheticEndpoint).latest("/sern/link")
        assert own.level == 2 and own.hardware_id == "relay"
        lab.process(lab.relay_file())
        await until(lambda: level(site, "robot1") == 0, "all is well")
        array = endpoint_of(site, SyntheticEndpoint).latest("/diagnostics")
        assert [item.hardware_id for item in array.status] == ["relay", "robot1"]


async def test_topics_of_a_robot_that_is_gone_end_and_come_back(tmp_path: Path) -> None:
    topics = [{"match": "/map", "class": "state", "reliability": "reliable", "durability": "transient_local"}]
    endpoint = ROBOT | {"topics": ["/pose", "/map"]}
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.process(lab.relay_file()).ready()
        robot = lab.process(lab.client_file("robot1", endpoint, topics=topics))
        site = await lab.connected(site_file(lab, link_state={"withdraw_after_s": 0.5, "period_s": 0.1}))
        here = endpoint_of(site, SyntheticEndpoint)

        def open_() -> set[str]:
            return {publisher.name for publisher in here._publishers if publisher.name.startswith("/robot1/")}

        received = here.received
        await until(lambda: (got := received("/robot1/map")) is not None and got.count >= 1, "the map came")
        everything = {"/robot1/pose", "/robot1/map", "/robot1/sern/link"}
        await until(lambda: open_() == everything, "all is there")
        robot.signal(signal.SIGSTOP)  # SIGSTOP: its streams go on when it does
        await until(lambda: open_() == {"/robot1/sern/link"}, "its topics end")
        assert not site.check.tables.validate()
        robot.signal(signal.SIGCONT)
        await until(lambda: open_() == everything, "its topics are back")
        await until(lambda: (got := received("/robot1/map")) is not None and got.count >= 2, "with what was latched")
        assert not site.check.tables.validate()


async def test_a_recording_has_the_state_of_the_link_if_it_is_to(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site", "other") as lab:
        await lab.process(lab.relay_file()).ready()
        robot = lab.process(lab.client_file("robot1", ROBOT))
        record = {"kind": "record", "path": "site.bag", "overwrite": True}
        site = lab.process(site_file(lab, endpoint=record))
        other = lab.process(lab.recorder_file("other", "/robot.*"))
        for process in (robot, site, other):
            await process.ready()
        await site.until(lambda: connected(site, "robot1"), "has the robot")
        await other.until(lambda: connected(other, "robot1"), "has the robot")
        robot.kill()
        await site.until(lambda: gone(site) == ["robot1"], "has lost the robot")
        for process in (site, other):
            await process.stop()
        store = get_typestore(Stores.ROS1_NOETIC)
        with Reader(tmp_path / "site.bag") as reader:
            levels = [
                store.deserialize_ros1(body, connection.msgtype).level  # type: ignore[attr-defined]
                for connection, _time_ns, body in reader.messages()
                if connection.topic == "/robot1/sern/link"
            ]
            assert {0, 2} <= set(levels)
        with Reader(tmp_path / "other.bag") as reader:
            assert set(reader.topics) == {"/robot1/pose"}


async def test_a_link_with_thirteen_times_what_it_carries_tells_of_a_lost_robot(tmp_path: Path) -> None:
    """The site is behind a link of 1 Mbit/s, for which another robot has clouds and poses of 16 Mbit/s."""
    model = LinkModel(rate_bps=1e6, delay_s=0.02)
    loud = {"topics": ["/points", "/pose"], "cloud_bytes": 100_000, "cloud_rate_hz": 20.0, "pose_rate_hz": 50.0}
    rules = [{"match": "/points", "class": "bulk", "compression": "none"}, {"match": "/pose", "class": "control"}]
    async with Lab(tmp_path, "robot1", "robot2", "site") as lab:
        relay = await lab.relay()
        robot1 = lab.process(lab.client_file("robot1", ROBOT))
        await robot1.ready()
        await lab.process(lab.client_file("robot2", ROBOT | loud, topics=rules)).ready()
        async with ShapingProxy(model, model, [Route((HOST, 0), (HOST, lab.port))], seed=1) as proxy:
            host, port = proxy.addresses[0]
            site = await lab.connected(site_file(lab, relay={"endpoint": f"tcp://{host}:{port}", "udp": False}))
            proxy.start()
            await until(lambda: level(site, "robot1") == level(site, "robot2") == 0, "it has both")
            ledger = relay.hub.links[ClientName("site")].sender.ledger

            def overloaded() -> bool:
                topics = ledger.topics.values()
                delivered = sum(each.delivered_bytes for each in topics)
                return 0 < 13 * delivered < sum(each.offered_bytes for each in topics)

            await until(overloaded, "its link is offered 13 times what it carries")
            robot1.kill()
            await until(lambda: level(site, "robot1") == 2, "it is said that one is gone")
            lab.process(tmp_path / "robot1.yaml")
            await until(lambda: level(site, "robot1") == 0, "and back")
            assert overloaded()
            await lab.end(site)
