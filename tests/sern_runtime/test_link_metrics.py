"""What the metrics of many links and topics tell, and what the alerts look for in them."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import generate_latest
from prometheus_client.openmetrics.exposition import generate_latest as generate_openmetrics
from prometheus_client.parser import text_string_to_metric_families

from sern_core.vocabulary.ledger import LOSSES, ReceiveCounters, ReceiveLedger, SendCounters
from sern_core.vocabulary.types import DropReason, PriorityClass, TopicName
from sern_runtime import metrics as module
from sern_runtime.link_metrics import AgeHistograms, register_links, register_received
from sern_runtime.metrics import SLICE_ROWS, Metrics, exposition
from tests.views import link_view

RULES = Path(__file__).parents[2] / "deploy" / "prometheus" / "sern.rules.yml"


def link(peer: str, topics: int) -> Any:
    counters = [SendCounters(TopicName(f"/r/t{n}"), PriorityClass.STATE) for n in range(topics)]
    view = link_view(peer=peer)
    return SimpleNamespace(peer=peer, counters={c.topic: c for c in counters}, queued=dict, observe=lambda *, now: view)


class Scene:
    """Links with topics, and their rows at /metrics."""

    def __init__(self, clients: int, topics: int) -> None:
        self.registry = CollectorRegistry()
        self.links = [link(f"site{n}", topics) for n in range(clients)]
        register_links(Metrics(self.registry, process=False), lambda: self.links)

    def rows(self, name: str) -> dict[tuple[str, ...], float]:
        text = b"".join(exposition(self.registry, generate_latest)).decode()
        return {
            tuple(sample.labels[label] for label in ("peer", "topic", "reason") if label in sample.labels): sample.value
            for family in text_string_to_metric_families(text)
            for sample in family.samples
            if sample.name == name
        }


def alerting() -> str:
    found = re.search(r'sern_messages_dropped_total\{[^}]*reason=~"([^"]+)"\}', RULES.read_text())
    assert found is not None
    return found[1]


def test_the_reasons_that_the_alert_looks_for_have_rows_from_the_start_on() -> None:
    assert set(alerting().split("|")) == {str(reason) for reason in LOSSES}


def test_a_lost_message_of_any_of_fifty_clients_and_a_hundred_topics_has_its_name() -> None:
    scene = Scene(50, 100)
    before = {
        key: n for key, n in scene.rows("sern_messages_dropped_total").items() if re.fullmatch(alerting(), key[2])
    }
    assert len(before) == 50 * 100 * 3 and not any(before.values())
    scene.links[49].counters["/r/t99"].drop(DropReason.RETENTION, 100)
    after = {key: n for key, n in scene.rows("sern_messages_dropped_total").items() if re.fullmatch(alerting(), key[2])}
    assert {key: n for key, n in after.items() if n != before[key]} == {("site49", "/r/t99", "retention"): 1.0}


def test_a_topic_too_many_keeps_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_LABEL_SETS", 10)
    scene = Scene(3, 10)
    scene.links[2].counters["/r/t9"].drop(DropReason.RETENTION, 100)
    scene.links[2].counters["/r/t9"].drop(DropReason.LIFESPAN, 100)
    rows = scene.rows("sern_messages_dropped_total")
    assert rows["other", "other", "retention"] == rows["other", "other", "lifespan"] == 1
    assert len(rows) == 11 * 3 + 1


def test_rows_under_other_stay_there_and_do_not_fall_when_a_link_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_LABEL_SETS", 10)
    scene = Scene(3, 10)
    for at in scene.links:
        at.counters["/r/t0"].drop(DropReason.RETENTION, 100)
    assert scene.rows("sern_messages_dropped_total")["other", "other", "retention"] == 2
    del scene.links[0]  # its ten names are free
    for _ in range(3):
        rows = scene.rows("sern_messages_dropped_total")
        assert {key for key, n in rows.items() if n} == {("other", "other", "retention")}
        assert rows["other", "other", "retention"] == 2
    del scene.links[0]
    assert scene.rows("sern_messages_dropped_total")["other", "other", "retention"] == 2
    scene.links[0].counters["/r/t0"].drop(DropReason.RETENTION, 100)
    assert scene.rows("sern_messages_dropped_total")["other", "other", "retention"] == 3
    scene.links.append(link("new", 10))
    assert scene.rows("sern_messages_dropped_total")["new", "/r/t0", "retention"] == 0


@pytest.mark.parametrize("encode", [generate_latest, generate_openmetrics])
def test_parts_make_the_same_text_and_each_is_small(encode: Any) -> None:
    scene = Scene(20, 100)
    parts = list(exposition(scene.registry, encode))
    assert b"".join(parts) == encode(scene.registry)
    assert max(part.count(b"\n") for part in parts) <= SLICE_ROWS + 2


def test_links_and_topics_may_go_while_a_scrape_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """More rows than are read in a step, and no more than a step's and a link's are read at a time."""
    monkeypatch.setattr(module, "STEP_ROWS", 50)
    scene = Scene(40, 20)
    parts = []
    for number, part in enumerate(exposition(scene.registry, generate_latest)):
        parts.append(part)
        if not part and number % 4 == 0:
            scene.links.append(link(f"new{number}", 20))
            for at in scene.links[:-1]:
                at.counters.pop(f"/r/t{number % 20}", None)
            del scene.links[number % len(scene.links)]
    assert parts.count(b"") > 20
    text = b"".join(parts).decode()
    assert list(text_string_to_metric_families(text))
    failures = [line for line in text.splitlines() if line.startswith("sern_metrics_failures_total{")]
    assert failures and all(line.endswith(" 0.0") for line in failures)


def test_what_is_lost_on_arrival_has_rows_from_the_start_on() -> None:
    registry, received = CollectorRegistry(), ReceiveLedger()
    register_received(Metrics(registry, process=False), received, AgeHistograms())
    received.topics[TopicName("/r/a")] = counters = ReceiveCounters(TopicName("/r/a"), PriorityClass.STATE)

    def rows() -> dict[str, float]:
        families = text_string_to_metric_families(generate_latest(registry).decode())
        samples = [sample for family in families for sample in family.samples]
        return {s.labels["reason"]: s.value for s in samples if s.name == "sern_received_dropped_total"}

    assert rows() == {"lost": 0, "undecodable": 0, "fault": 0}
    counters.drop_arrived(DropReason.DUPLICATE)
    counters.drop_arrived(DropReason.LOST)
    assert rows() == {"lost": 1, "undecodable": 0, "fault": 0, "duplicate": 1}
