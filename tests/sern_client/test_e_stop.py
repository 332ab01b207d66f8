"""Emergency stops: what latches one, what it stops, what survives, and what releases it."""

import errno
import logging
from pathlib import Path

import pytest

from sern_client import e_stop
from sern_client.e_stop import EStop, EStops, says_stop
from sern_core.topics.patterns import PatternSet
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.events import EventLog

STOP, DRIVE = TopicName("/e_stop"), TopicName("/cmd_vel")
BOOL, EMPTY = "std_msgs/msg/Bool", "std_msgs/msg/Empty"


def body(encoding: Encoding, *, on: bool) -> bytes:
    return ros_types.serialise(ros_types.new(BOOL, encoding, data=on), BOOL, encoding)


class Robot:
    def __init__(self, path: Path) -> None:
        self.halted = 0
        self.events = EventLog()
        self.stops = EStops([EStop(STOP, PatternSet(["/cmd_.*"]))], path, self.events, halt=self._halt)

    def _halt(self, names: PatternSet) -> None:
        assert names.fullmatch(DRIVE)
        self.halted += 1

    def hears(self, *, on: bool) -> None:
        self.stops.heard(TopicInfo(STOP, BOOL, Encoding.CDR), body(Encoding.CDR, on=on), where="site1")


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
def test_a_bool_says_what_it_says_and_any_other_message_is_a_stop(encoding: Encoding) -> None:
    info = TopicInfo(STOP, BOOL, encoding)
    assert says_stop(info, body(encoding, on=True)) and not says_stop(info, body(encoding, on=False))
    assert says_stop(info, b""), "what is cut off is taken for a stop"
    assert says_stop(TopicInfo(STOP, EMPTY, encoding), b"")


def test_it_stays_latched_whatever_the_topic_says_until_it_is_released_by_name(tmp_path: Path) -> None:
    robot = Robot(tmp_path / "state")
    robot.hears(on=False)
    assert robot.stops.stopped(DRIVE) is None and robot.halted == 0
    robot.hears(on=True)
    robot.hears(on=False)
    assert robot.stops.stopped(DRIVE) == STOP and robot.stops.stopped(TopicName("/arm")) is None and robot.halted == 1
    with pytest.raises(UsageError, match="/other is no e-stop of this client; /e_stop"):
        robot.stops.release(TopicName("/other"), who="site1")
    robot.stops.release(STOP, who="site1")
    assert robot.stops.stopped(DRIVE) is None
    with pytest.raises(UsageError, match="not latched: there is nothing to release"):
        robot.stops.release(STOP, who="site1")


def test_it_survives_the_end_of_the_process_and_so_does_its_release(tmp_path: Path) -> None:
    path = tmp_path / "state"
    Robot(path).hears(on=True)
    again = Robot(path)
    assert again.stops.stopped(DRIVE) == STOP
    again.stops.release(STOP, who="an operator")
    assert Robot(path).stops.stopped(DRIVE) is None


@pytest.mark.parametrize("damaged", [b"", b"[1]", b"{", b"\xff" * 100])
def test_a_file_that_cannot_be_read_counts_as_latched(
    tmp_path: Path, damaged: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "state"
    path.write_bytes(damaged)
    assert Robot(path).stops.stopped(DRIVE) == STOP
    assert "cannot be read" in caplog.text and "every e-stop counts as latched" in caplog.text


def test_where_it_cannot_be_kept_the_client_does_not_start(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written to, and an e-stop must survive a restart"):
        Robot(tmp_path / "missing" / "state")


def test_a_full_disk_ends_no_stop(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot stands before the disk is asked."""
    caplog.set_level(logging.INFO)
    robot = Robot(tmp_path / "state")
    halted: list[int] = []

    def full(_path: Path, _text: str) -> None:
        halted.append(robot.halted)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(e_stop, "write_whole", full)
    robot.hears(on=True)
    assert halted == [1]
    assert robot.stops.stopped(DRIVE) == STOP and robot.halted == 1
    assert "could not be kept" in caplog.text
