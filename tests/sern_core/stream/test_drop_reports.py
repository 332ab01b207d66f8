"""Reports of drops of one stream: they cover what was reported, whatever the order, and there are few of them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_core.stream.drop_reports import UNREAD_S, DropReports, UnackedReports
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.limits import PeerLimits
from sern_core.vocabulary.types import DropReason

REASONS = (DropReason.LOST, DropReason.RETENTION, DropReason.UNWANTED)
ADDS = st.tuples(
    st.just("add"), st.integers(1, 60), st.sampled_from(REASONS), st.sampled_from(["a", "b"]), st.integers(1, 12)
)
STEPS = st.one_of(
    ADDS,
    ADDS,
    st.tuples(st.just("say"), st.booleans()),
    st.tuples(st.just("acknowledged"), st.integers(0, 4)),
    st.tuples(st.just("unsay")),
)


def checked(reports: DropReports, unacked: UnackedReports) -> DropReports:
    def check(ok: bool, text: str) -> None:
        assert ok, text

    reports.validate(check, "/t")
    assert (unacked.reports, unacked.said) == (len(reports), reports.said)
    return reports


def told(reports: DropReports, *, runs: bool = True) -> list[tuple[int, int, DropReason, str]]:
    """Everything that is not on its way yet, which it is afterwards."""
    found = []
    number = 10**6
    while (report := reports.first(runs=runs)) is not None:
        found.append((report.seq, report.count, report.reason, report.where))
        number += 1
        reports.say(report, number)
    return found


@given(st.lists(STEPS, max_size=60), st.sampled_from([0, 3, 1000]))
def test_reports_cover_exactly_what_was_reported(steps: list[tuple], limit: int) -> None:  # type: ignore[type-arg]
    unacked = UnackedReports(PeerLimits(reports=limit))
    reports = DropReports(unacked)
    waits: dict[int, set[tuple[DropReason, str]]] = {}  # what was ever reported of a message that is to be said
    flying: list[tuple[int, set[int]]] = []
    number = 0
    for kind, *step in steps:
        if kind == "add":
            seq, reason, where, count = step
            reports.add(seq, reason, where, count)
            for each in range(seq, seq + count):
                waits.setdefault(each, set()).add((reason, where))
        elif kind == "say":
            report = reports.first(runs=step[0])
            if report is not None:
                number += 1
                reports.say(report, number)
                seqs = set(range(report.seq, report.end))
                for seq in seqs:
                    assert limit < 1000 or (report.reason, report.where) in waits[seq]
                    del waits[seq]
                flying.append((number, seqs))
            else:
                assert not waits
        elif kind == "acknowledged":
            reached = number - step[0]
            flying = [each for each in flying if each[0] > reached]
            assert reports.acknowledged(reached) == (not flying and not waits)
        else:
            reports.unsay()
            for _number, seqs in flying:
                for seq in seqs:
                    waits.setdefault(seq, set()).update((reason, where) for reason in REASONS for where in "ab")
            flying = []
        checked(reports, unacked)
    found = [seq for first, count, _reason, _where in told(reports) for seq in range(first, first + count)]
    assert sorted(found) == sorted(waits), "a message is left out, or said twice"
    reports.clear()
    assert (unacked.reports, unacked.said) == (0, 0)


@given(st.permutations(range(1, 30)))
def test_a_run_is_one_report_in_whatever_order_its_messages_are_dropped(seqs: list[int]) -> None:
    reports = DropReports(UnackedReports())
    for seq in seqs:
        reports.add(seq, DropReason.LOST, "site")
    assert told(reports) == [(1, 29, DropReason.LOST, "site")]


def test_what_was_said_is_not_changed() -> None:
    unacked = UnackedReports()
    reports = DropReports(unacked)
    reports.add(5, DropReason.LOST, "site", 2)
    said = reports.first(runs=True)
    assert said is not None
    reports.say(said, 1)
    reports.add(7, DropReason.LOST, "site")
    reports.add(4, DropReason.LOST, "site")
    assert (said.seq, said.count) == (5, 2) and len(reports) == 3
    checked(reports, unacked).unsay()
    assert told(reports) == [(4, 4, DropReason.LOST, "site")]


def test_a_message_is_reported_for_the_first_client_that_does_not_get_it() -> None:
    reports = DropReports(UnackedReports())
    reports.add(3, DropReason.LOST, "eve")
    reports.add(1, DropReason.RETENTION, "site", 5)
    reports.add(2, DropReason.UNWANTED, "other", 2)
    assert told(reports) == [
        (1, 2, DropReason.RETENTION, "site"),
        (3, 1, DropReason.LOST, "eve"),
        (4, 2, DropReason.RETENTION, "site"),
    ]


def test_above_the_limit_a_run_takes_the_place_of_what_it_holds() -> None:
    unacked = UnackedReports(PeerLimits(reports=100))
    reports = DropReports(unacked)
    for seq in range(2, 2 * 103 + 1, 2):
        reports.add(seq, DropReason.LOST, "eve")
    assert unacked.crowded
    reports.add(3, DropReason.LOST, "site")  # between two: all three are one
    assert len(checked(reports, unacked)) == 102
    reports.add(21, DropReason.UNWANTED, "site", 100)
    assert len(checked(reports, unacked)) == 52
    assert (20, 101, DropReason.LOST, "") in told(reports)


def test_no_more_is_kept_than_there_is_room_for() -> None:
    unacked = UnackedReports(PeerLimits(reports=10, kept_reports=50))
    reports = DropReports(unacked)
    for seq in range(200, 0, -2):
        reports.add(seq, DropReason.LOST, "eve")
    assert len(checked(reports, unacked)) == 50
    reports.add(199, DropReason.LOST, "eve")  # joins two
    reports.add(1, DropReason.LOST, "eve")
    assert len(checked(reports, unacked)) == 50 and told(reports)[0][:2] == (1, 1)


class TestAPeerThatDoesNotRead:
    def crowd(self) -> tuple[UnackedReports, DropReports]:
        unacked = UnackedReports(PeerLimits(reports=10))
        reports = DropReports(unacked)
        for seq in range(1, 41, 2):
            reports.add(seq, DropReason.LOST, "eve")
        return unacked, reports

    def sends(self, unacked: UnackedReports, start_s: float, for_s: float) -> None:
        for tick in range(int(10 * for_s)):
            unacked.check(start_s + 0.1 * tick)

    def test_it_is_not_judged_by_what_it_was_not_told(self) -> None:
        unacked, _reports = self.crowd()
        self.sends(unacked, 0.0, 1000.0)
        assert unacked.crowded

    def test_it_is_cut_when_it_has_gone_on_for_long(self) -> None:
        unacked, reports = self.crowd()
        report = reports.first(runs=True)
        assert report is not None
        reports.say(report, 1)
        self.sends(unacked, 100.0, UNREAD_S - 1.0)
        with pytest.raises(WireError, match="read none of the 1 reports"):
            self.sends(unacked, 100.0 + UNREAD_S - 1.0, 1.5)

    @pytest.mark.parametrize("again", ["it hears of one", "a session begins"])
    def test_it_has_the_time_again(self, again: str) -> None:
        unacked, reports = self.crowd()
        for number in range(1, 6):
            report = reports.first(runs=True)
            assert report is not None
            reports.say(report, number)
        for number in range(1, 5):
            self.sends(unacked, 9.0 * number, 9.0)
            if again == "it hears of one":
                assert not reports.acknowledged(number)
            else:
                unacked.begin()
        with pytest.raises(WireError):
            self.sends(unacked, 50.0, 11.0)

    def test_a_time_when_we_were_held_up_counts_little(self) -> None:
        unacked, reports = self.crowd()
        report = reports.first(runs=True)
        assert report is not None
        reports.say(report, 1)
        self.sends(unacked, 0.0, 5.0)
        unacked.check(3600.0)  # its acknowledgement lies behind this message
        assert not reports.acknowledged(1) and unacked.crowded
