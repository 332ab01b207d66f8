"""A file of kept messages: whole, cut off anywhere, damaged anywhere, and none at all."""

from pathlib import Path
from random import Random

import pytest
from mcap.reader import make_reader

from sern_core.vocabulary.types import Encoding
from sern_runtime.spool.files import GrowingFile, messages_of, read_index, read_runs
from tests.exploring import cases
from tests.sern_runtime.spool.kept import message, stream

COUNT = 2000


def write(path: Path, *, finish: bool = True) -> Path:
    file = GrowingFile(path)
    other = stream("/robot1/odom", encoding=Encoding.ROS1, reliable=True)
    for seq in range(1, COUNT + 1):
        file.add(message(seq, 300))
        if seq % 2:
            file.add(message(seq, 50, of=other))
    assert len(file.unflushed) == COUNT * 3 // 2
    assert len(file.finish() if finish else file.flush()) == COUNT * 3 // 2
    if not finish:
        assert file.abandon() == []
    return path


@pytest.mark.parametrize("finish", [True, False])
def test_what_was_written_is_found_and_read_by_its_numbers(tmp_path: Path, *, finish: bool) -> None:
    index = read_index(write(tmp_path / "a.mcap", finish=finish))
    assert (index.problem is None) is finish
    points, odom = index.contents.values()
    assert (points.stream, odom.stream.info.encoding) == (stream(), Encoding.ROS1)
    assert odom.stream.info.reliable is True and odom.stream.info.definition == "string data"
    assert (points.messages, points.first, points.last, points.nbytes) == (COUNT, 1, COUNT, COUNT * 300)
    assert len(points.marks) > 3
    runs = ((1, 2), (900, 903), (1999, 9000))
    found = list(read_runs(index, 1, runs))
    assert [each.seq for each in found] == [1, 2, 900, 901, 902, 903, 1999, 2000]
    assert all(each.message.data == message(each.seq, 300).body for each in found)
    assert all(each.message.log_time == message(each.seq).stamp_ns for each in found)
    assert [each.seq for each in read_runs(index, 2, ((1, 6),))] == [1, 3, 5]
    assert list(read_runs(index, 1, ((5000, 6000),))) == []


def test_the_index_of_a_file_says_the_same_as_its_messages(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap")
    whole, index = path.read_bytes(), read_index(path)
    (tmp_path / "b.mcap").write_bytes(whole[: len(whole) - 8])  # the end is missing: every message is read
    other = read_index(tmp_path / "b.mcap")
    assert other.problem is not None
    for content, same in zip(index.contents.values(), other.contents.values(), strict=True):
        content.marks.clear()  # where it stands, or where what is told before it does
        same.marks.clear()
    assert other.contents == index.contents


def test_numbers_beyond_32_bits_come_back(tmp_path: Path) -> None:
    file = GrowingFile(tmp_path / "a.mcap")
    for seq in (2**32 - 1, 2**32, 2**40 + 3):
        file.add(message(seq)._replace(stamp_ns=2**70))
    file.finish()
    with (tmp_path / "a.mcap").open("rb") as opened:
        assert [each.seq for each in messages_of(opened)] == [2**32 - 1, 2**32, 2**40 + 3]
    index = read_index(tmp_path / "a.mcap")
    assert [each.seq for channel in index.contents for each in read_runs(index, channel, ((2**32, 2**41),))] == [
        2**32,
        2**40 + 3,
    ]


def test_anybody_can_read_it(tmp_path: Path) -> None:
    with write(tmp_path / "a.mcap").open("rb") as file:
        found = [(channel.topic, record.log_time) for _schema, channel, record in make_reader(file).iter_messages()]
    assert len(found) == COUNT * 3 // 2
    assert {topic for topic, _stamp in found} == {"/robot1/points", "/robot1/odom"}


def test_a_file_that_was_cut_off_has_what_is_whole_of_it(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mcap", finish=False).read_bytes()
    random = Random(1)
    for length in sorted({0, 1, 7, 8, 9, 100, *(random.randrange(len(whole)) for _ in range(cases(40)))}):
        path = tmp_path / "b.mcap"
        path.write_bytes(whole[:length])
        index = read_index(path)
        assert index.problem is not None
        found = [each for channel in index.contents for each in read_runs(index, channel, ((1, COUNT),))]
        assert len(found) == index.messages <= COUNT * 3 // 2
        assert all(each.message.data[:8] == each.seq.to_bytes(8, "big") for each in found)
        assert index.messages >= length // 400 - 2


def test_a_bit_that_flips_in_a_message_is_noticed(tmp_path: Path) -> None:
    """Wherever in it: its body, its number, its stamp, its checksum; and no other message is lost."""
    path = write(tmp_path / "a.mcap", finish=False)
    whole = bytearray(path.read_bytes())
    with path.open("rb") as file:
        at = next(each.offset for each in messages_of(file) if each.seq == 900)
    number, stamp, body, checksum = at + 9 + 2, at + 9 + 6, at + 9 + 22 + 100, at + 9 + 22 + 300 + 9
    for place in (number, stamp, body, checksum):
        whole[place] ^= 4
        path.write_bytes(whole)
        whole[place] ^= 4
        index = read_index(path)
        assert index.messages == COUNT * 3 // 2 - 1
        found = list(read_runs(index, 1, ((1, COUNT),)))
        assert [each.seq for each in found if each.whole] == [seq for seq in range(1, COUNT + 1) if seq != 900]


def test_any_bytes_are_a_file_or_a_problem(tmp_path: Path) -> None:
    whole = bytearray(write(tmp_path / "a.mcap").read_bytes())
    random = Random(2)
    path = tmp_path / "b.mcap"
    for _ in range(cases(60)):
        damaged = bytearray(whole)
        for _ in range(3):
            damaged[
                random.choice((random.randrange(2000), random.randrange(len(whole)), -random.randrange(1, 3000)))
            ] = random.randrange(256)
        path.write_bytes(damaged)
        index = read_index(path)
        assert index.size_bytes == len(whole)
        assert index.problem is not None or index.messages >= 0
    path.write_bytes(b"hello, this is another file")
    assert read_index(path).problem is not None and not read_index(path).contents
