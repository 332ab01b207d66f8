"""Messages to keep."""

from sern_core.vocabulary.message import StreamId, TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_runtime.spool.files import Kept, KeptStream

START_NS = 10**18


def stream(
    topic: str = "/robot1/points", boot: int = 5, *, encoding: Encoding = Encoding.CDR, reliable: bool = False
) -> KeptStream:
    info = TopicInfo(TopicName(topic), "std_msgs/msg/String", encoding, "RIHS01_00", "string data", True, reliable)
    return KeptStream(StreamId(ClientName("robot1"), boot, TopicName(topic)), info)


def message(seq: int, size_bytes: int = 100, *, of: KeptStream | None = None) -> Kept:
    """A second after the one before it."""
    return Kept(of or stream(), seq, START_NS + seq * 10**9, seq.to_bytes(8, "big") + bytes(size_bytes - 8))
