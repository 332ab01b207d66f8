"""What a site writes down beside what it fetches: what it has, and what people ask for."""

from pathlib import Path

import pytest

from sern_client.spool import ledger, orders
from sern_core.site.spool import ALWAYS, Window
from sern_core.vocabulary.types import TopicName

TOPIC = TopicName("/robot1/points")
KNOWN = {TOPIC: {5: ((1, 10), (12, 12)), 2**62: ((7, 8),)}}


def test_the_ledger_comes_back_as_it_was(tmp_path: Path) -> None:
    assert ledger.load(tmp_path) == {}
    ledger.save(tmp_path, KNOWN)
    ledger.save(tmp_path, KNOWN)
    assert ledger.load(tmp_path) == KNOWN
    assert [path.name for path in tmp_path.iterdir()] == [ledger.FILE]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"version": 2, "topics": {}}', '{"version": 1}', '{"version": 1, "topics": {"/a": 3}}',
             '{"version": 1, "topics": {"/a": {"x": []}}}', "[" * 100_000]
)  # fmt: skip
def test_a_ledger_that_cannot_be_read_is_put_aside_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str
) -> None:
    (tmp_path / ledger.FILE).write_text(text)
    assert ledger.load(tmp_path) == {}
    assert "is put aside as" in caplog.text
    assert (tmp_path / f"{ledger.FILE}.damaged").read_text() == text
    assert ledger.load(tmp_path) == {}


def test_orders_are_found_until_they_are_taken_away(tmp_path: Path) -> None:
    (tmp_path / orders.FOLDER).mkdir()
    first = orders.place(tmp_path, orders.Order(TOPIC, ALWAYS))
    second = orders.place(tmp_path, orders.Order(TOPIC, Window(1, 2)))
    found = orders.look(tmp_path, set())
    assert found == {first: orders.Order(TOPIC, ALWAYS), second: orders.Order(TOPIC, Window(1, 2))}
    first.unlink()
    assert list(orders.look(tmp_path, set())) == [second]


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"topic": "x y", "from_ns": 1, "to_ns": 2}', '{"topic": "/a", "from_ns": 3, "to_ns": 2}',
             '{"topic": "/a", "from_ns": "1", "to_ns": 2}', '{"topic": "/a", "from_ns": 1, "to_ns": 1e400}', "9" * 9000]
)  # fmt: skip
def test_what_is_no_order_is_said_once_and_left(tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str) -> None:
    (tmp_path / orders.FOLDER).mkdir()
    (tmp_path / orders.FOLDER / "x.json").write_text(text)
    said: set[str] = set()
    assert orders.look(tmp_path, said) == orders.look(tmp_path, said) == {}
    assert caplog.text.count("is no order of `sern spool fetch`") == 1 and "delete it" in caplog.text


def test_there_are_never_more_orders_than_are_looked_at(tmp_path: Path) -> None:
    (tmp_path / orders.FOLDER).mkdir()
    for _ in range(orders.MAX_ORDERS + 5):
        orders.place(tmp_path, orders.Order(TOPIC, ALWAYS))
    assert len(orders.look(tmp_path, set())) == orders.MAX_ORDERS
