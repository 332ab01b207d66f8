"""A node of ROS 2 that comes late is told who is there."""

from rosbags.typesys import Stores, get_typestore

from sern_client.link_topics import STATUS_TYPE, LinkTopics, LinkView
from sern_core.site.peers import PeerStatus
from sern_core.vocabulary.types import Encoding
from tests.peers.dds.conftest import MakeEndpoint, MakePeer
from tests.support import until

STATUS = "diagnostic_msgs::msg::dds_::DiagnosticStatus_"
STAMP_NS = 1_700_000_000_123_456_789


def view(status: PeerStatus, since_s: float) -> LinkView:
    return LinkView("robot1", False, status, since_s, 0.5, 0.1, "robot1", "udp", "")


async def test_a_late_reader_gets_the_last_state(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    peer = await make_peer(domain)
    endpoint, recorder = await make_endpoint(domain)
    topics = LinkTopics("site", Encoding.CDR, endpoint.advertise, diagnostics=True)
    topics.publish([view(PeerStatus.CONNECTED, 60.0)], STAMP_NS)
    topics.publish([view(PeerStatus.GONE, 2.0)], STAMP_NS)
    await peer.do(f"sub late rt/robot1/sern/link {STATUS} reliable transient_local depth=1")
    store = get_typestore(Stores.ROS2_JAZZY)

    def last() -> tuple[int, str]:
        message = store.deserialize_cdr(peer.got("late")[-1], STATUS_TYPE)
        return message.level, message.message  # type: ignore[attr-defined]

    await until(lambda: peer.got("late") and last() == (2, "robot1 is gone for 2 s"), "it is told")
    topics.publish([view(PeerStatus.CONNECTED, 0.0)], STAMP_NS)
    await until(lambda: last() == (0, "robot1 is connected"), "and of what comes after")
    assert recorder.infos == {}  # our own topics are no news
    topics.close()
    await peer.line("matched late 0")
