"""What others see of us in the ROS graph, and what is done about types nobody knows."""

import logging
from pathlib import Path

import pytest

from sern_client.endpoints.dds import node_info
from sern_client.endpoints.dds.node_info import Node
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime.ros_types import topic_info
from tests.peers.dds.conftest import MakeEndpoint, MakePeer
from tests.support import until

INFO = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"
STRING = "std_msgs::msg::dds_::String_"


async def test_we_are_a_node(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    """`ros_discovery_info`, read by an independent peer: name, and the writers that we have, as they come and go."""
    peer = await make_peer(domain)
    endpoint, _ = await make_endpoint(domain, node_name="sern_jackal")
    await peer.do(f"sub info ros_discovery_info {INFO} reliable transient_local depth=1")
    await peer.line("matched info 1")
    await peer.do(f"pub old rt/old {STRING}")
    await until(lambda: bool(endpoint.graph.writers("rt/old")))
    assert not peer.got("info"), "nobody said a hash: nodes of before Iron could not read it"
    await peer.do(f"pub new rt/new {STRING} userdata=typehash=RIHS01_0;")
    await peer.line("got info ")
    publisher = endpoint.advertise(topic_info("/chat", "std_msgs/msg/String", Encoding.CDR))

    def nodes() -> list[Node]:
        found = node_info.decode(peer.got("info")[-1])
        assert found is not None and found[0] == endpoint.graph.own
        return found[1]

    await peer.until(lambda: publisher.writer.guid.bytes in node_info.by_entity(nodes()))
    assert [node.name for node in nodes()] == ["/sern_jackal"]
    publisher.close()
    await peer.until(lambda: publisher.writer.guid.bytes not in node_info.by_entity(nodes()))


async def test_nodes_of_others_are_named(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    one, _ = await make_endpoint(domain, node_name="one")
    two, _ = await make_endpoint(domain, node_name="two", accept_bridged=True)
    one.advertise(topic_info("/chat", "std_msgs/msg/String", Encoding.CDR))
    await until(lambda: [two.graph.owner(writer) for writer in two.graph.writers("rt/chat")] == ["node /one"])


async def test_a_type_nobody_knows(
    domain: int, tmp_path: Path, make_peer: MakePeer, make_endpoint: MakeEndpoint, caplog: pytest.LogCaptureFixture
) -> None:
    """It is said once what to do; with the definition in `type_paths`, or another version of a known type, it works."""
    peer = await make_peer(domain)
    wrong = "RIHS01_" + "0" * 64
    with caplog.at_level(logging.ERROR):
        _, recorder = await make_endpoint(domain)
        await peer.do(f"pub a rt/known {STRING}")
        await peer.do(f"pub b rt/other_version {STRING} userdata=typehash={wrong};")
        await until(lambda: TopicName("/known") in recorder.infos and len(caplog.records) == 1)
    (record,) = caplog.records
    assert record.message.startswith("/other_version of participant peer")
    assert wrong in record.message and "type_paths" in record.message
    known = topic_info("/x", "std_msgs/msg/String", Encoding.CDR).type_hash
    assert known in record.message
    await peer.do(f"pub c rt/right_version {STRING} userdata=typehash={known};")
    await until(lambda: TopicName("/right_version") in recorder.infos)

    folder = tmp_path / "std_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "String.msg").write_text("string data\nuint8 more\n")
    endpoint, recorder = await make_endpoint(domain, type_paths=(tmp_path,))
    await until(lambda: TopicName("/known") in recorder.infos)
    assert recorder.infos[TopicName("/known")].definition == "string data\nuint8 more\n"
    with pytest.raises(ConfigError, match="no_msgs/msg/Such is unknown here"):
        endpoint.types.message("no_msgs/msg/Such")
