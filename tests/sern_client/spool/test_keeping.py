"""What stands before a kept topic: all is kept, under the number of the live stream or one that this leaves out."""

from dataclasses import replace

import pytest

from sern_client.spool.keeping import Taps
from sern_core.topics.patterns import compile_pattern
from sern_core.vocabulary.types import PriorityClass
from sern_runtime import clock
from sern_runtime.spool.files import Kept
from tests.world import World, spec


class Rig:
    """A topic `/points` whose live stream is sent to through `live`, which does what each test wants with it."""

    def __init__(self, *, reliable: bool = False) -> None:
        self.world = World()
        robot = self.world.client("robot1")
        self.core = robot.core
        self.channel = robot.publish("/robot1/points", spec(PriorityClass.BULK, reliable=reliable))
        self.kept: list[Kept] = []
        self.taps = Taps(self.core, (compile_pattern("/points"),), self._put)
        self.fate = "sent"
        self.sink = self.taps.open(self.channel, lambda body: b"framed " + body, self.live)

    def _put(self, kept: Kept) -> bool:
        self.kept.append(kept)
        return True

    def live(self, body: bytes, stamp_ns: int) -> bool:
        if self.fate == "refused":
            return False
        if self.fate in ("sent", "summary"):
            seq = self.channel.next_seq
            whole = body if self.fate == "sent" else b"small"
            self.core.send(self.channel, b"framed " + whole, stamp_ns, now=clock.now())
            self.taps.sent(self.channel.stream.id, seq, whole, b"framed " + whole)
        return True

    @property
    def rows(self) -> list[tuple[int, int, bytes]]:
        return [(kept.seq, kept.stamp_ns, kept.body) for kept in self.kept]


def test_what_is_sent_is_kept_under_its_number() -> None:
    rig = Rig()
    assert rig.sink(b"a", 1) and rig.sink(b"b", 2)
    assert rig.rows == [(1, 1, b"framed a"), (2, 2, b"framed b")]
    stream = rig.kept[0].stream
    assert stream.id == rig.channel.stream.id
    assert stream.info == replace(rig.channel.stream.info, reliable=False)


@pytest.mark.parametrize("fate", ["thinned", "summary"])
def test_what_is_not_sent_as_it_came_is_kept_under_a_number_that_the_live_stream_leaves_out(fate: str) -> None:
    rig = Rig()
    rig.sink(b"a", 1)
    rig.fate = fate
    rig.sink(b"b", 2)
    rig.fate = "sent"
    rig.sink(b"c", 3)
    seqs = [seq for seq, _stamp, _body in rig.rows]
    assert [body for _seq, _stamp, body in rig.rows] == [b"framed a", b"framed b", b"framed c"]
    assert seqs == [1, 2, 3] if fate == "thinned" else seqs == [1, 3, 4]
    assert rig.channel.next_seq == seqs[-1] + 1


def test_what_is_refused_and_offered_again_is_kept_once() -> None:
    rig = Rig(reliable=True)
    rig.fate = "refused"
    assert not rig.sink(b"a", 1) and not rig.sink(b"a", 1)
    rig.fate = "sent"
    assert rig.sink(b"a", 1)
    assert rig.rows == [(1, 1, b"framed a")]


def test_what_is_refused_and_lost_is_kept() -> None:
    """A publisher that cannot wait offers the next one, or ends."""
    rig = Rig(reliable=True)
    rig.fate = "refused"
    assert not rig.sink(b"a", 1) and not rig.sink(b"b", 2)
    rig.taps.close(rig.channel.stream.id)
    assert rig.rows == [(1, 1, b"framed a"), (2, 2, b"framed b")]
    assert not rig.taps.taken(rig.channel.stream.id)
    rig.taps.sent(rig.channel.stream.id, 9, b"x", b"x")
    assert len(rig.kept) == 2


def test_only_what_the_file_names_is_kept() -> None:
    rig = Rig()
    assert rig.taps.wants(rig.channel.stream.info.name.removeprefix("/robot1"))  # type: ignore[arg-type]
    assert not rig.taps.wants(rig.channel.stream.info.name)
