"""The tables of bridge and endpoint are compared now and then; what differs is said, counted and opened anew."""

import logging
from collections.abc import Sequence
from itertools import pairwise

import pytest

from sern_client.checks import CHECK_S, CONFIRM_S, REPAIR_S, TableCheck
from sern_client.endpoints.base import Difference, Held
from sern_client.endpoints.ros1.publication import Handle
from sern_core.vocabulary.types import Encoding, TopicName
from tests.sern_client.endpoints.ros1.fakes import FakeMaster, running
from tests.sern_client.sessions import Changes
from tests.support import until

ODOM = Difference(TopicName("/odom"), "lost", "publisher")
MAP = Difference(TopicName("/map"), "late")


class Tables:
    def __init__(self) -> None:
        self.found: list[Difference] = []
        self.repaired: list[Difference] = []
        self.looks = 0

    def validate(self) -> list[Difference]:
        self.looks += 1
        return list(self.found)

    def repair(self, differences: Sequence[Difference]) -> None:
        self.repaired += differences


def test_what_differs_twice_is_a_fault_until_it_is_gone(caplog: pytest.LogCaptureFixture) -> None:
    tables = Tables()
    check = TableCheck(tables, now=0.0)
    check.tick(now=CHECK_S - 0.5)
    assert tables.looks == 0
    tables.found = [ODOM, MAP]
    check.tick(now=CHECK_S)
    assert check.found == [] and check.total == 0  # it may be under way
    tables.found = [ODOM]
    for turn in range(1, 4):
        check.tick(now=CHECK_S + turn * CONFIRM_S)
        assert check.found == [ODOM] and check.total == 1 and set(tables.repaired) == {ODOM}
    assert [record.message for record in caplog.records] == ["what is here is not what should be: /odom: lost"]
    tables.found = []
    check.tick(now=CHECK_S + 4 * CONFIRM_S)
    assert check.found == [] and check.total == 1
    looks = tables.looks
    check.tick(now=CHECK_S + 5 * CONFIRM_S)
    assert tables.looks == looks  # not before another minute


def test_what_a_repair_does_not_mend_is_repaired_again_more_and_more_seldom(caplog: pytest.LogCaptureFixture) -> None:
    tables = Tables()
    tables.found = [ODOM]
    check, now = TableCheck(tables, now=0.0), CHECK_S
    check.tick(now=now)
    repairs: list[float] = []
    while now < 3600.0:
        now += CONFIRM_S
        before = len(tables.repaired)
        check.tick(now=now)
        repairs += [now] * (len(tables.repaired) - before)
    pauses = [later - earlier for earlier, later in pairwise(repairs)]
    assert pauses[:6] == [5.0, 10.0, 20.0, 40.0, 80.0, 160.0] and set(pauses[6:]) == {REPAIR_S[1]}
    assert check.total == 1 and len(caplog.records) == 1  # said and counted once
    tables.found = []
    check.tick(now=now + CONFIRM_S)
    tables.found = [ODOM]
    before = len(tables.repaired)
    for turn in range(2):
        check.tick(now=now + CONFIRM_S + CHECK_S + turn * CONFIRM_S)
    assert len(tables.repaired) == before + 1 and check.total == 2  # another time, at once


def test_tables_that_cannot_be_compared_end_nothing(caplog: pytest.LogCaptureFixture) -> None:
    class Broken(Tables):
        def validate(self) -> list[Difference]:
            raise KeyError("a table")

    check = TableCheck(Broken(), now=0.0)
    with caplog.at_level(logging.ERROR):
        check.tick(now=CHECK_S)
    assert "could not be compared" in caplog.text


def test_what_differed_is_not_said_to_be_right_when_nobody_can_tell(caplog: pytest.LogCaptureFixture) -> None:
    class Failing(Tables):
        broken = False

        def validate(self) -> list[Difference]:
            if self.broken:
                raise KeyError("a table")
            return super().validate()

    tables = Failing()
    tables.found = [ODOM]
    check = TableCheck(tables, now=0.0)
    for turn, tables.broken in enumerate((False, False, True, False)):
        check.tick(now=CHECK_S + turn * CONFIRM_S)
        assert check.found == [ODOM] * (turn > 0)
    assert check.total == 1 and "again" not in caplog.text
    tables.found = []
    check.tick(now=CHECK_S + 4 * CONFIRM_S)
    assert caplog.messages[-1] == "what is here is what should be again: /odom, after 15 s"


def test_a_repair_that_cannot_be_done_is_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    class Broken(Tables):
        def repair(self, differences: Sequence[Difference]) -> None:
            super().repair(differences)
            raise OSError("the master is away")

    tables = Broken()
    tables.found = [ODOM]
    check = TableCheck(tables, now=0.0)
    for turn in range(3):
        check.tick(now=CHECK_S + turn * CONFIRM_S)
    assert tables.repaired == [ODOM, ODOM] and caplog.text.count("could not be opened anew") == 2


async def test_a_publisher_that_its_endpoint_has_lost_is_opened_anew(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        changes = Changes(endpoint, 1, encoding=Encoding.ROS1)
        try:
            await changes.run()
            await changes.at_rest()
            assert changes.wanted
            lost = next(iter(changes.wanted))
            publication = endpoint._publications[lost]
            publication.close()  # as if a fault had ended it behind the back of everybody
            del endpoint._publications[lost]
            found = changes.tables.validate()
            assert [each.name for each in found if each.kind == "publisher"] == [lost]
            changes.tables.repair(found)
            await until(lambda: changes.tables.validate() == [])
            assert endpoint._publications[lost] is not publication
            assert all(isinstance(handle, Handle) for handle in endpoint._publications[lost].handles)
        finally:
            changes.close()
        assert endpoint.validate(Held()) == []
