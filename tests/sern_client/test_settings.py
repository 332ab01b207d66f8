"""What is set by hand on top of a file, and what a reload leaves of it."""

import json
from pathlib import Path
from typing import Any

import pytest

from sern_client.settings import MAX_SET, Settings
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, PriorityClass, TopicName
from sern_runtime.config.client import ClientFile
from sern_runtime.config.load import check_bytes

SCAN, CLOUD = TopicName("/front/scan"), TopicName("/points")
KNOWN = {name: TopicInfo(name, kind, Encoding.CDR) for name, kind in ((SCAN, "sensor_msgs/msg/LaserScan"),
                                                                   (CLOUD, "sensor_msgs/msg/PointCloud2"))}  # fmt: skip


def file(*topics: dict[str, Any], **sections: Any) -> ClientFile:
    content = {
        "client": {"name": "robot1"},
        "relay": {"endpoint": "ipc:///tmp/relay", "insecure": True},
        "endpoint": {"kind": "synthetic", "role": "robot"},
        "topics": list(topics),
        **sections,
    }
    checked = check_bytes(json.dumps(content).encode(), Path("robot1.yaml"), ClientFile)
    assert checked.loaded is not None, checked.errors
    return checked.loaded.model


class Site:
    """Keeps the files that were had in force."""

    def __init__(self, of: ClientFile) -> None:
        self.used: list[ClientFile] = [of]
        self.settings = Settings(of, self.used.append, lambda: KNOWN)

    def rule(self, name: TopicName) -> Any:
        rules = self.used[-1].rules()
        index = rules.find(KNOWN[name].type_name, name)
        return None if index is None else rules.rules[index]


def test_what_is_set_holds_for_this_topic_alone_whatever_its_rule_matches() -> None:
    site = Site(file({"match": ".*/scan", "class": "state", "depth": 3}, {"match": ".*"}))
    assert site.settings.set(SCAN, ["max_rate_hz=2", "class=control"]) == {"max_rate_hz": 2, "class": "control"}
    rule = site.rule(SCAN)
    assert (rule.max_rate_hz, rule.priority, rule.depth) == (2.0, PriorityClass.CONTROL, 3)
    rules = site.used[-1].rules()
    other = rules.rules[rules.find("sensor_msgs/msg/LaserScan", TopicName("/rear/scan")) or 0]
    assert other.max_rate_hz is None and other.priority is PriorityClass.STATE
    site.settings.set(SCAN, ["max_rate_hz=null"])
    assert site.rule(SCAN).max_rate_hz is None and site.rule(SCAN).priority is PriorityClass.CONTROL
    site.settings.reset(SCAN)
    assert site.used[-1] == site.used[0] and site.settings.by_topic == {}


def test_a_topic_without_a_rule_and_one_with_a_rule_of_its_own_can_be_set() -> None:
    site = Site(file({"match": str(SCAN), "class": "state"}))
    site.settings.set(CLOUD, ["compression=zstd"])
    site.settings.set(SCAN, ["depth=2"])
    assert site.rule(CLOUD).compression == "zstd" and site.rule(SCAN).depth == 2
    assert len(site.used[-1].topics) == 2


@pytest.mark.parametrize(
    "word", ["speed=1", "depth=0", "depth", "=3", "class=urgent", "depth={", "match=/x", "weight=a"]
)
def test_what_is_wrong_changes_nothing(word: str) -> None:
    site = Site(file({"match": ".*"}))
    with pytest.raises(UsageError) as caught:
        site.settings.set(SCAN, ["depth=2", word])
    assert "\n" not in str(caught.value) and site.used == site.used[:1] and site.settings.by_topic == {}


def test_what_the_file_says_otherwise_is_the_files_again() -> None:
    site = Site(file({"match": ".*/scan", "depth": 3}))
    site.settings.set(SCAN, ["depth=5", "weight=2"])
    site.settings.set(CLOUD, ["depth=7"])
    done = site.settings.reload(file({"match": ".*/scan", "depth": 4}, http={"listen": "127.0.0.1:1234"}))
    assert done.ended == ("/front/scan depth",) and done.restart == ("http",)
    assert site.settings.by_topic == {SCAN: {"weight": 2}, CLOUD: {"depth": 7}}
    assert (site.rule(SCAN).depth, site.rule(SCAN).weight, site.rule(CLOUD).depth) == (4, 2.0, 7)
    assert site.settings.reload(site.settings.file).ended == ()


def test_a_file_that_cannot_be_used_leaves_all_as_it_was() -> None:
    before = file({"match": ".*/scan"})
    used: list[ClientFile] = []

    def once(each: ClientFile) -> None:
        if used:
            raise UsageError("no")
        used.append(each)

    settings = Settings(before, once, lambda: KNOWN)
    settings.set(SCAN, ["depth=5"])
    with pytest.raises(UsageError, match="no"):
        settings.reload(file({"match": ".*/scan", "depth": 9}))
    assert settings.file is before and settings.by_topic == {SCAN: {"depth": 5}}


def test_a_profile_is_set_and_given_back() -> None:
    site = Site(file(adaptation={"profile": "teleoperation", "interval_s": 2.0}))
    site.settings.set_profile("mapping")
    adaptation = site.used[-1].adaptation
    assert adaptation is not None and (adaptation.profile, adaptation.interval_s) == ("mapping", 2.0)
    with pytest.raises(UsageError, match=r"profile: 'racing' is not accepted .*; accepted: teleoperation, mapping"):
        site.settings.set_profile("racing")
    site.settings.set_profile(None)
    assert site.used[-1] == site.used[0] and site.settings.profile is None


def test_no_more_topics_than_a_limit_are_set_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sern_client.settings.MAX_SET", 1)
    site = Site(file({"match": ".*"}))
    site.settings.set(SCAN, ["depth=2"])
    with pytest.raises(UsageError, match="1 topics are set by hand, which is the limit"):
        site.settings.set(CLOUD, ["depth=2"])
    site.settings.set(SCAN, ["depth=3"])
    assert MAX_SET > 1 and site.settings.by_topic == {SCAN: {"depth": 3}}
