"""`sern spool`: what people write and read, and one recording of several."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from sern_client.endpoints.bag_files import BagFile, McapFile
from sern_core.site.spool import EVER, Window
from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_core.vocabulary.message import StreamId, TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_runtime.ros_types import topic_info
from sern_runtime.spool.files import GrowingFile, Kept, KeptStream
from sern_tools.commands import app
from sern_tools.spool import check_order, listing, size_text, stamp_ns, stamp_text, window
from sern_tools.spool_merge import Selection, merge
from tests.daemons import bodies

TOPIC = "/robot1/chat"
FIRST_NS = 1_700_000_000_000_000_000
SECOND_NS = 10**9

ANSWER: dict[str, Any] = {
    "directory": "/var/lib/sern/filled",
    "max_bytes": 4_000_000_000,
    "keeps": True,
    "fetches": True,
    "kept_bytes": 1_500,
    "filled_bytes": 2_500_000,
    "problem": None,
    "automatic": False,
    "kept": [{"topic": "/r/odom", "messages": 10, "bytes": 1000, "first_ns": FIRST_NS, "last_ns": FIRST_NS}],
    "fetch": [
        {
            "topic": TOPIC,
            "origin": "robot1",
            "there": True,
            "kept_messages": 3000,
            "kept_bytes": 51_000,
            "first_ns": FIRST_NS,
            "last_ns": FIRST_NS + 60 * SECOND_NS,
            "missing_messages": 12,
            "missing_bytes": 204,
            "fetched_messages": 2900,
            "gone_messages": 0,
        }
    ],
    "orders": [{"topic": TOPIC, "from_ns": EVER[0], "to_ns": FIRST_NS}],
}


def test_times_are_read_as_people_write_them() -> None:
    assert (
        stamp_ns("2023-11-14T22:13:20Z") == stamp_ns("1700000000") == stamp_ns("2023-11-14T23:13:20+01:00") == FIRST_NS
    )
    assert stamp_ns("2023-11-14T22:13:20.5") == FIRST_NS + SECOND_NS // 2
    assert stamp_text(FIRST_NS) == "2023-11-14T22:13:20Z" and stamp_text(None) == "-"
    assert stamp_text(2**63 - 1).startswith("2262")
    assert window(None, None) == Window(*EVER)
    for begin, end in (
        ("yesterday", None),
        ("2024-01-01", "2023-01-01"),
        ("1e300", None),
        ("nan", None),
        (None, "inf"),
    ):
        with pytest.raises(UsageError):
            window(begin, end)


def test_the_list_fits_a_terminal_and_says_what_is_missing() -> None:
    lines = listing(ANSWER)
    assert all(len(line) <= 100 for line in lines)
    assert any(TOPIC in line and "3,000" in line and " 12 " in line and "2,900" in line for line in lines)
    assert any("asked for: /robot1/chat, the beginning to 2023-11-14T22:13:20Z" in line for line in lines)
    away = ANSWER | {"fetch": [ANSWER["fetch"][0] | {"there": False}], "problem": "disk full"}
    assert any("robot1 is away" in line for line in listing(away))
    assert listing(away)[0] == "nothing is written there now: disk full"
    assert [size_text(n) for n in (0, 999, 1500, 10**9, 10**15)] == ["0 B", "999 B", "1.5 kB", "1.0 GB", "1000.0 TB"]


def test_what_cannot_be_fetched_is_one_line_that_says_what_there_is() -> None:
    early = Window(0, 1)
    assert check_order(ANSWER, TOPIC, Window(*EVER)) == ""
    for answer, topic, wanted, words in (
        (ANSWER, "/robot1/none", Window(*EVER), "kept are: /robot1/chat"),
        (ANSWER, TOPIC, early, "nothing is kept from then; there is 2023-11-14T22:13:20Z to 2023-11-14T22:14:20Z"),
        (ANSWER | {"fetches": False}, TOPIC, early, "sern spool merge /var/lib/sern/filled --out FILE"),
    ):
        with pytest.raises(SernError, match=words):
            check_order(answer, topic, wanted)
    away = ANSWER | {"fetch": [ANSWER["fetch"][0] | {"there": False}]}
    assert check_order(away, TOPIC, Window(*EVER)) == f"robot1 is away; {TOPIC} is fetched when it is back"


# --- merge ------------------------------------------------------------------------------------------------------------


def text(number: int) -> bytes:
    word = f"message {number}".encode()
    return len(word).to_bytes(4, "little") + word


def info(encoding: Encoding = Encoding.ROS1) -> TopicInfo:
    return topic_info(TOPIC, "std_msgs/msg/String", encoding)


def recording(path: Path, numbers: list[int], encoding: Encoding = Encoding.ROS1) -> Path:
    file = BagFile(path) if encoding is Encoding.ROS1 else McapFile(path)
    file.add(info(encoding))
    for number in numbers:
        file.write(info(encoding), FIRST_NS + number * SECOND_NS, text(number))
    file.finish()
    return path


def fetched(path: Path, numbers: list[int], encoding: Encoding = Encoding.ROS1, *, stamp: int | None = None) -> Path:
    path.parent.mkdir(exist_ok=True)
    file = GrowingFile(path)
    stream = KeptStream(StreamId(ClientName("robot1"), 5, TopicName(TOPIC)), info(encoding))
    for number in numbers:
        file.add(Kept(stream, number, FIRST_NS + (number if stamp is None else stamp) * SECOND_NS, text(number)))
    file.finish()
    return path


@pytest.mark.parametrize(("encoding", "suffix"), [(Encoding.ROS1, ".bag"), (Encoding.CDR, ".mcap")])
def test_one_recording_comes_of_several_by_stamp_with_everything_once(
    tmp_path: Path, encoding: Encoding, suffix: str
) -> None:
    live = recording(tmp_path / f"live{suffix}", [1, 4, 9], encoding)
    fetched(tmp_path / "filled" / "filled-1.mcap", [3, 2, 8], encoding)
    fetched(tmp_path / "filled" / "filled-2.mcap", [5, 4, 7, 6], encoding)  # 4 is there twice
    done = merge([live, tmp_path / "filled"], tmp_path / f"whole{suffix}", Selection())
    assert (done.messages, done.twice) == (9, 1)
    assert bodies(tmp_path / f"whole{suffix}") == {TOPIC: [text(number) for number in range(1, 10)]}
    part = Selection(TopicName(TOPIC), FIRST_NS + 3 * SECOND_NS, FIRST_NS + 5 * SECOND_NS)
    assert merge([live, tmp_path / "filled"], tmp_path / f"part{suffix}", part).messages == 3


def test_other_messages_of_the_same_stamp_stay(tmp_path: Path) -> None:
    fetched(tmp_path / "filled" / "filled-1.mcap", [1, 2, 3, 2], stamp=7)
    done = merge([tmp_path / "filled"], tmp_path / "whole.bag", Selection())
    assert (done.messages, done.twice) == (3, 1)


def test_of_a_file_that_was_cut_off_what_is_whole_is_there(tmp_path: Path) -> None:
    path = fetched(tmp_path / "filled" / "filled-1.mcap", list(range(1, 101)))
    path.write_bytes(path.read_bytes()[:3000])
    done = merge([path], tmp_path / "whole.bag", Selection())
    assert done.cut_off == [path] and 10 < done.messages < 100
    assert bodies(tmp_path / "whole.bag")[TOPIC] == [text(number) for number in range(1, done.messages + 1)]


def test_a_message_that_was_damaged_on_the_disk_is_left_out_and_said(tmp_path: Path) -> None:
    path = fetched(tmp_path / "a.mcap", list(range(10)))
    damaged = bytearray(path.read_bytes())
    damaged[damaged.index(text(4)) + len(text(4)) - 1] ^= 1
    path.write_bytes(damaged)
    done = CliRunner().invoke(app, ["spool", "merge", str(path), "--out", str(tmp_path / "whole.bag")])
    assert done.exit_code == 0 and "damaged on the disk and left out: 1\n" in done.output
    assert bodies(tmp_path / "whole.bag")[TOPIC] == [text(number) for number in range(10) if number != 4]


def test_what_cannot_be_merged_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    live = recording(tmp_path / "live.bag", [1, 2])
    (tmp_path / "bad.bag").write_bytes(b"no bag")
    (tmp_path / "bad.mcap").write_bytes(b"no mcap")
    (tmp_path / "empty").mkdir()
    before = sorted(path.name for path in tmp_path.iterdir())
    for inputs, out, chosen, words in (
        ([live], "whole.txt", Selection(), "must end in .bag"),
        ([live], "live.bag", Selection(), "exists already"),
        ([live], "whole.mcap", Selection(), "is of ROS 1, which this kind of file does not hold; name a .bag"),
        ([live], "whole.bag", Selection(TopicName("/no")), "would be empty"),
        ([tmp_path / "none.bag"], "whole.bag", Selection(), "no such file or folder"),
        ([tmp_path / "empty"], "whole.bag", Selection(), "has no .bag and no .mcap files"),
        ([tmp_path / "bad.bag"], "whole.bag", Selection(), "cannot be read as a recording"),
        ([tmp_path / "bad.mcap"], "whole.mcap", Selection(), "cannot be read as a recording"),
    ):
        with pytest.raises(ConfigError, match=words):
            merge(inputs, tmp_path / out, chosen)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_the_command_says_what_came_of_it(tmp_path: Path) -> None:
    live = recording(tmp_path / "live.bag", [1, 2])
    out = str(tmp_path / "whole.bag")
    done = CliRunner().invoke(app, ["spool", "merge", str(live), str(live), "--out", out])
    assert done.exit_code == 0 and done.output == f"{out}: 2 messages, 2 that were there twice are left out\n"
    again = CliRunner().invoke(app, ["spool", "merge", str(live), "--out", out])
    assert again.exit_code == 2 and "exists already" in again.output
    assert CliRunner().invoke(app, ["spool", "ls", "--api", "nonsense"]).exit_code == 2
