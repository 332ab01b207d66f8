"""CPU limits are multiples of what a bare forwarder takes here and now."""

import pytest

pytest.importorskip("psutil")

from benchmarks import reference
from benchmarks.common import Report
from benchmarks.link.forwarder import Forwarder
from sern_core.vocabulary.errors import SernError


def test_the_bare_forwarder_is_measured_over_real_sockets() -> None:
    took_us = reference.forwarding_us(batches=2)
    assert 0.1 < took_us < 1e5, "opening and sealing 1200 bytes takes longer than nothing, and no second"


def test_a_cost_is_held_as_a_multiple_and_both_sides_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reference, "forwarding_us", lambda: 8.0)
    report = Report("x")
    reference.reach_forwarding(report, "CPU of a turn", 2.0, 0.3)
    reference.reach_forwarding(report, "CPU of a decision", 4000.0, 400.0)
    assert [(reach.name, reach.value, reach.ok) for reach in report.reaches] == [
        ("CPU of a turn, by that of forwarding one datagram", 0.25, True),
        ("CPU of a decision, by that of forwarding one datagram", 500.0, False),
    ]
    assert report.notes[0] == "CPU of a turn: 2 µs of CPU; the bare forwarder takes 8 µs for a datagram"


def test_a_datagram_that_is_lost_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(forwarder: Forwarder) -> None:
        raise BlockingIOError("nothing came")

    monkeypatch.setattr(Forwarder, "step", refuse)
    with pytest.raises(SernError, match="lost a datagram over loopback"):
        reference.forwarding_us(batches=1)
