"""What a client's spool does at its start and end when its directory is not as it should be."""

import errno
import json
from pathlib import Path

import pytest

from sern_client.endpoints.record import RecordEndpoint, RecordOptions
from sern_client.site import Site
from sern_client.spool import ledger
from sern_client.spool import spool as spool_module
from sern_client.spool.spool import Spool
from sern_core.topics.rules import RuleSet
from sern_core.topics.spool_names import kept_name, parse
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, TopicName
from sern_runtime.config.spool import SpoolSection
from sern_runtime.spool.store import Store
from tests.sern_client.test_keeping import FakeKeeper
from tests.world import World

TOPIC = TopicName("/robot1/points")
KNOWN = {TOPIC: {5: ((1, 10),)}}


def spool(tmp_path: Path) -> Spool:
    """A site that fetches /robot1/points."""
    site = Site(RecordEndpoint(RecordOptions(tmp_path / "run")), RuleSet(()), "/", kick=lambda: None)
    section = SpoolSection(directory="filled", fetch=(TOPIC,))
    return Spool(World().client("site1").core, site, section, tmp_path / "filled")


def reports(topic: TopicName) -> StreamInfo:
    name = kept_name(topic)
    return StreamInfo(StreamId(ClientName("robot1"), 5, name), TopicInfo(name, "sern/Kept", Encoding.RAW), TopicSpec())


async def test_what_is_known_outlives_the_process_and_nobody_elses_is_touched(tmp_path: Path) -> None:
    """A second client in the same place does not start, and at its end it leaves alone what the first one knows."""
    first, second = spool(tmp_path), spool(tmp_path)
    first.start()
    ledger.save(tmp_path / "filled", KNOWN)
    with pytest.raises(ConfigError, match="another process keeps messages there"):
        second.start()
    await second.close()
    assert ledger.load(tmp_path / "filled") == KNOWN
    await first.close()
    ledger.save(tmp_path / "filled", KNOWN)
    third = spool(tmp_path)
    third.start()
    await third.close()
    assert ledger.load(tmp_path / "filled") == KNOWN


async def test_a_disk_that_is_full_at_the_start_is_one_line_and_costs_only_the_fetch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(_self: Store) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Store, "open", full)
    made = spool(tmp_path)
    made.start()
    assert made.problem is not None and len(caplog.records) == 1
    made.look()
    assert json.loads(json.dumps(made.to_json()))["problem"] == made.problem
    await made.close()
    assert not (tmp_path / "filled").exists()


async def test_what_the_recording_lost_is_not_known_as_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording says at once that it has no room for a message, long before it says up to where it is flushed."""
    recording = FakeKeeper()
    monkeypatch.setattr(spool_module, "keepers_of", lambda _endpoint: [recording])
    made = spool(tmp_path)
    made.start()
    assert made.fetching is not None
    live = StreamId(ClientName("robot1"), 5, TOPIC)
    for seq in (1, 2):
        mark = made.fetching.mark(live)
        assert mark is not None
        recording.taken += 1
        made.fetching.published(live, seq, mark)
    recording.told(0, {1: DropReason.STORAGE})
    recording.told(2, {})
    await made.close()
    assert ledger.load(tmp_path / "filled") == {TOPIC: {5: ((2, 2),)}}


async def test_only_what_the_file_names_is_taken(tmp_path: Path) -> None:
    made = spool(tmp_path)
    made.start()
    known, other = reports(TOPIC), reports(TopicName("/robot1/odom"))
    parts = parse(known.id.topic), parse(other.id.topic)
    assert parts[0] is not None and parts[1] is not None
    made.stream_opened(known, parts[0])
    with pytest.raises(ConfigError, match=r"/robot1/odom is not in spool\.fetch"):
        made.stream_opened(other, parts[1])
    await made.close()
