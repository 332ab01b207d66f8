"""Routing: matches against brute force, ownership of names, boots, access on both sides, what each call reports."""

import re
from dataclasses import replace

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.interest import NAME_UNITS, RoutingLimits
from sern_core.relay.route_change import NO_CHANGE, Denied, Match, RouteChange
from sern_core.relay.routing import RoutingTable
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, PriorityClass, TopicName
from tests.exploring import cases

OPEN = AccessTable([AccessRule(".*", publish=(".*",), subscribe=(".*",))])
A, B, C = ClientName("a"), ClientName("b"), ClientName("c")


def stream(
    origin: str,
    topic: str,
    *,
    boot: int = 1,
    many: bool = False,
    type_name: str = "std_msgs/String",
    type_hash: str = "",
    encoding: Encoding = Encoding.ROS1,
) -> StreamInfo:
    name = TopicName(topic)
    return StreamInfo(
        StreamId(ClientName(origin), boot, name),
        TopicInfo(name, type_name, encoding, type_hash),
        TopicSpec(many_writers=many),
    )


def refusal(table: RoutingTable, info: StreamInfo) -> RefusedError:
    before = table.infos()
    with pytest.raises(RefusedError) as caught:
        table.announce(info)
    assert table.infos() == before
    assert "\n" not in str(caught.value)
    table.validate()
    return caught.value


def test_interest_before_and_after_the_stream() -> None:
    table = RoutingTable(OPEN)
    odom = stream("a", "/a/odom")
    assert table.subscribe(B, ["/a/.*"]) == NO_CHANGE
    assert table.announce(odom) == RouteChange(added=(odom.id,), matched=(Match(B, odom.id),), wanted=(odom.id,))
    assert table.subscribe(C, exact=[TopicName("/a/odom")]) == RouteChange(matched=(Match(C, odom.id),))
    assert table.subscribers(odom.id) == (B, C)
    assert table.received_by(C) == (odom.id,)
    assert table.subscribe(B, ["/b/.*"]) == RouteChange(unmatched=(Match(B, odom.id),))
    assert table.wanted(odom.id)
    assert table.subscribe(C) == RouteChange(unmatched=(Match(C, odom.id),), unwanted=(odom.id,))
    assert not table.wanted(odom.id) and table.known(odom.id)
    assert table.withdraw(odom.id) == RouteChange(removed=(odom.id,))
    assert table.withdraw(odom.id) == NO_CHANGE
    assert table.subscribers(odom.id) == () and table.info(odom.id) is None
    table.validate()


def test_a_change_is_true_when_there_is_something_to_do() -> None:
    assert not NO_CHANGE
    assert RouteChange(added=(StreamId(A, 1, TopicName("/x")),))


def test_never_back_to_the_origin() -> None:
    table = RoutingTable(OPEN)
    table.subscribe(A, [".*"])
    table.subscribe(B, [".*"])
    mine, theirs = stream("a", "/tf", many=True), stream("b", "/tf", many=True)
    assert table.announce(mine).matched == (Match(B, mine.id),)
    assert table.announce(theirs).matched == (Match(A, theirs.id),)
    assert table.received_by(A) == (theirs.id,)
    assert table.owners(TopicName("/tf")) == (A, B)
    table.validate()


def test_a_second_owner_is_refused_by_name() -> None:
    table = RoutingTable(OPEN)
    table.announce(stream("a", "/odom"))
    error = refusal(table, stream("b", "/odom"))
    assert error.code == "name_taken"
    assert str(error) == (
        "b may not publish /odom: a owns that name; give b a namespace, remap the topic, "
        "or declare it many_writers at both clients"
    )
    assert refusal(table, stream("b", "/odom", many=True)).code == "name_taken"
    table.withdraw(StreamId(A, 1, TopicName("/odom")))
    assert table.announce(stream("b", "/odom")).added
    table.validate()


def test_many_writers_must_agree_on_that_and_on_the_type() -> None:
    table = RoutingTable(OPEN)
    table.announce(stream("a", "/tf", many=True, type_name="tf2_msgs/TFMessage", type_hash="1"))
    assert refusal(table, stream("b", "/tf", type_name="tf2_msgs/TFMessage")).code == "name_taken"
    error = refusal(table, stream("b", "/tf", many=True, type_name="tf/tfMessage"))
    assert error.code == "type_mismatch" and "tf/tfMessage" in str(error) and "tf2_msgs/TFMessage at a" in str(error)
    error = refusal(table, stream("b", "/tf", many=True, type_name="tf2_msgs/TFMessage", type_hash="2"))
    assert error.code == "type_mismatch" and "hash 2, and 1 at a" in str(error)
    ros2 = stream("b", "/tf", many=True, type_name="tf2_msgs/msg/TFMessage", type_hash="2", encoding=Encoding.CDR)
    assert table.announce(ros2).added == (ros2.id,)
    error = refusal(table, replace(ros2, spec=TopicSpec(many_writers=False)))
    assert error.code == "name_taken"


def test_a_new_boot_replaces_all_of_the_old() -> None:
    table = RoutingTable(OPEN)
    table.subscribe(B, [".*"])
    old_x, old_y, new_x = stream("a", "/x", boot=9), stream("a", "/y", boot=9), stream("a", "/x", boot=3)
    table.announce(old_x)
    table.announce(old_y)
    assert table.announce(new_x) == RouteChange(
        added=(new_x.id,),
        removed=(old_x.id, old_y.id),
        matched=(Match(B, new_x.id),),
        unmatched=(Match(B, old_x.id), Match(B, old_y.id)),
        wanted=(new_x.id,),
    )
    assert refusal(table, old_y).code == "old_boot"
    assert table.streams_of(A) == (new_x.id,)
    table.drop_client(A)
    assert table.announce(old_y).added  # gone for good: nothing is remembered
    table.validate()


def test_a_refused_announcement_of_a_new_boot_keeps_the_old_boot() -> None:
    table = RoutingTable(OPEN)
    table.announce(stream("b", "/taken"))
    table.announce(stream("a", "/x", boot=1))
    assert refusal(table, stream("a", "/taken", boot=2)).code == "name_taken"
    assert table.streams_of(A) == (StreamId(A, 1, TopicName("/x")),)


def test_announcing_again() -> None:
    table = RoutingTable(OPEN)
    table.subscribe(B, [".*"])
    info = stream("a", "/x")
    table.announce(info)
    assert table.announce(replace(info)) == NO_CHANGE
    changed = replace(info, spec=TopicSpec(priority=PriorityClass.STATE))
    assert table.announce(changed) == RouteChange(updated=(info.id,))
    assert table.info(info.id) is changed


@pytest.mark.parametrize("name", ["", "x", "/", "/x/", "//x", "/x y", "/x\0", "/x\n", "/" + "x" * 255])
def test_names_that_are_no_topics_are_refused(name: str) -> None:
    assert refusal(RoutingTable(OPEN), stream("a", name)).code == "bad_name"


def test_limits() -> None:
    table = RoutingTable(OPEN, limits=RoutingLimits(max_streams=2, max_patterns=1, max_exact=1))
    table.announce(stream("a", "/x"))
    table.announce(stream("a", "/y"))
    assert refusal(table, stream("a", "/z")).code == "too_many_streams"
    assert table.announce(replace(stream("a", "/y"), spec=TopicSpec(depth=3))).updated
    assert table.announce(stream("a", "/z", boot=2)).added  # the old boot's streams make room
    table.subscribe(B, ["/x"])
    with pytest.raises(RefusedError, match="b asks for 2 patterns and 0 names; at most 1 and 1") as caught:
        table.subscribe(B, ["/x", "/y"])
    assert caught.value.code == "too_many_patterns"
    with pytest.raises(RefusedError, match="no look-around") as caught:
        table.subscribe(B, ["(?=x)"])
    assert caught.value.code == "bad_pattern"
    assert table.subscribe(B, ["/x"]) == NO_CHANGE  # the earlier interest stayed


def test_access_on_both_sides() -> None:
    table = RoutingTable(
        AccessTable(
            [
                AccessRule("a", publish=("/{self}/.*",)),
                AccessRule("b", subscribe=("/a/odom",)),
            ]
        )
    )
    table.subscribe(B, [".*"])
    secret = TopicName("/a/secret")
    assert table.subscribe(C, exact=[secret]).denied == (Denied(C, secret),)
    assert refusal(table, stream("a", "/b/x")).code == "forbidden"
    assert table.announce(stream("a", "/a/odom")).matched == (Match(B, StreamId(A, 1, TopicName("/a/odom"))),)
    change = table.announce(stream("a", "/a/secret"))
    assert (change.matched, change.denied) == ((), ())  # it may not know that there is such a topic
    table.validate()


def test_a_reload_takes_rights_away_and_gives_them_back() -> None:
    table = RoutingTable(OPEN)
    table.subscribe(B, exact=[TopicName("/a/x")])
    table.subscribe(C, [".*"])
    a_x, b_y = stream("a", "/a/x"), stream("b", "/b/y")
    table.announce(a_x)
    table.announce(b_y)
    assert table.pairs() == ((A, "/a/x"), (B, "/a/x"), (B, "/b/y"), (C, "/a/x"), (C, "/b/y"))
    narrow = AccessTable([AccessRule("a", publish=(".*",)), AccessRule("c", subscribe=(".*",))])
    assert table.set_access(narrow) == RouteChange(
        removed=(b_y.id,),
        unmatched=(Match(B, a_x.id), Match(C, b_y.id)),
        denied=(Denied(B, TopicName("/a/x")),),
    )
    table.validate()
    assert table.set_access(OPEN) == RouteChange(matched=(Match(B, a_x.id),))
    table.validate()


def test_a_reload_that_swaps_the_only_subscriber_leaves_the_stream_wanted() -> None:
    table = RoutingTable(AccessTable([AccessRule("a", publish=(".*",)), AccessRule("b", subscribe=(".*",))]))
    x = stream("a", "/x")
    table.announce(x)
    table.subscribe(B, [".*"])
    table.subscribe(C, [".*"])
    swapped = AccessTable([AccessRule("a", publish=(".*",)), AccessRule("c", subscribe=(".*",))])
    change = table.set_access(swapped)
    assert (change.matched, change.unmatched) == ((Match(C, x.id),), (Match(B, x.id),))
    assert (change.wanted, change.unwanted) == ((), ())


def test_dropping_a_client() -> None:
    table = RoutingTable(OPEN)
    x, y = stream("a", "/x"), stream("b", "/y")
    table.announce(x)
    table.announce(y)
    table.subscribe(A, [".*"])
    table.subscribe(B, [".*"])
    assert table.drop_client(A) == RouteChange(
        removed=(x.id,), unmatched=(Match(A, y.id), Match(B, x.id)), unwanted=(y.id,)
    )
    assert table.drop_client(A) == NO_CHANGE
    table.validate()


def test_fifty_clients_of_twenty_topics() -> None:
    table = RoutingTable(OPEN)
    clients = [ClientName(f"robot{number}") for number in range(50)]
    for number, client in enumerate(clients):
        table.subscribe(client, [".*/odom", f"/robot{(number + 1) % 50}/.*", "/map|/costmap.*"])
    for client in clients:
        table.announce(stream(client, f"/{client}/odom"))
        for number in range(19):
            table.announce(stream(client, f"/{client}/t{number}"))
    assert len(table.infos()) == 1000
    assert sum(len(table.subscribers(info.id)) for info in table.infos()) == 50 * 49 + 50 * 19
    for client in clients:
        assert len(table.received_by(client)) == 49 + 19
    for client in clients:
        table.drop_client(client)
    assert table.infos() == ()
    table.validate()


# The price of patterns ------------------------------------------------------------------------------------------------

HOSTILE = ["/(?:.{0,100}){0,6}!", "/(?:.{0,100}){0,6}?"]


def full_table(access: AccessTable = OPEN, *, topics: int = 500) -> RoutingTable:
    table = RoutingTable(access)
    for number in range(topics):
        table.announce(stream("a", f"/a/sensors/number_{number}"))
    return table


def test_a_pattern_is_not_matched_with_what_the_client_may_not_have() -> None:
    table = full_table(AccessTable([AccessRule("a", publish=(".*",)), AccessRule("c", subscribe=(".*_7",))]))
    table.subscribe(B, HOSTILE)
    cost_without_rights = table.spent.units
    table.subscribe(C, HOSTILE)
    assert 1 < table.spent.units / cost_without_rights < 1.5  # one name of 500
    assert not table.unfinished(B) and not table.unfinished(C)


def test_hostile_patterns_are_matched_in_slices() -> None:
    table = full_table()
    change = table.subscribe(B, HOSTILE)
    largest_units = 0
    matched = list(change.matched)
    slices = 1
    while table.unfinished(B):
        largest_units = max(largest_units, table.spent.units)
        table.validate()
        matched += table.go_on(B).matched
        slices += 1
    assert slices > 10
    assert largest_units < 1.2 * RoutingLimits().slice_units
    assert len(matched) == len(set(matched)) == 500


def test_the_usual_patterns_need_few_slices() -> None:
    table = full_table(topics=2000)
    slices = 0
    for client, patterns in ((B, [".*/odom", "/b/.*", "/map|/costmap.*"]), (C, ["/c/(?:odom|imu)"])):
        table.subscribe(client, patterns)
        slices += 1
        while table.unfinished(client):
            table.go_on(client)
            slices += 1
    assert slices <= 4


def test_what_changes_while_an_interest_is_worked_out() -> None:
    table = full_table()
    table.subscribe(B, ["/.*_1"])
    table.subscribe(B, [".*"])
    late, gone = stream("a", "/late"), StreamId(A, 1, TopicName("/a/sensors/number_499"))
    assert table.unfinished(B)
    assert table.announce(late).matched == (Match(B, late.id),)  # what is new is matched at once
    assert table.withdraw(gone).unmatched == ()  # its turn had not come
    narrow = AccessTable([AccessRule("a", publish=(".*",)), AccessRule("b", subscribe=("/late",))])
    change = table.set_access(narrow)
    assert len(change.unmatched) > 1 and not change.matched
    assert table.received_by(B) == (late.id,)
    table.validate()
    while table.unfinished(B):
        assert not table.go_on(B)
    assert table.subscribe(B) == RouteChange(unmatched=(Match(B, late.id),), unwanted=(late.id,))
    assert table.go_on(B) == table.go_on(C) == NO_CHANGE
    table.validate()


def test_all_patterns_of_a_client_together_are_bounded() -> None:
    table = RoutingTable(OPEN)
    table.subscribe(B, ["/x"])
    with pytest.raises(RefusedError, match="b: the patterns are too large together") as caught:
        table.subscribe(B, [f"/{letter}(?:.{{0,100}}){{0,6}}" for letter in "abc"])
    assert caught.value.code == "too_many_patterns"
    assert table.announce(stream("a", "/x")).matched  # the earlier interest stayed


def test_all_streams_together_have_channel_numbers() -> None:
    table = RoutingTable(OPEN, limits=RoutingLimits(max_all_streams=2))
    table.announce(stream("a", "/x"))
    table.announce(stream("b", "/y"))
    assert refusal(table, stream("c", "/z")).code == "too_many_streams"
    assert table.announce(replace(stream("b", "/y"), spec=TopicSpec(depth=3))).updated
    assert RoutingLimits().max_all_streams < 0xFFFF


def test_one_more_name_costs_one_look_and_has_an_end() -> None:
    table = RoutingTable(OPEN, limits=RoutingLimits(max_exact=50))
    for index in range(50):
        table.announce(stream(A, f"/t{index}"))
        change = table.also(B, TopicName(f"/t{index}"))
        assert [match.stream.topic for match in change.matched] == [f"/t{index}"]
        assert table.spent.units == NAME_UNITS and not table.unfinished(B)
    with pytest.raises(RefusedError) as refused:
        table.also(B, TopicName("/another"))
    assert refused.value.code == "too_many_patterns"
    assert table.also(B, TopicName("/t0")) == NO_CHANGE
    assert len(table.received_by(B)) == 50
    table.validate()


# Against brute force -------------------------------------------------------------------------------------------------

CLIENTS = tuple(ClientName(name) for name in "abc")
TOPICS = tuple(TopicName(name) for name in ("/x", "/y", "/a/x", "/b/x", "/tf"))
PATTERNS = (".*", "/x", "/[ab]/.*", "/tf|/y", "/a/.*")
TABLES = (
    OPEN,
    AccessTable(),
    AccessTable([AccessRule("a", publish=(".*",), subscribe=("/b/.*",)), AccessRule(".*", subscribe=("/{self}/.*",))]),
    AccessTable([AccessRule("[bc]", publish=("/tf", "/{self}/.*"), subscribe=(".*",))]),
)


class RoutingMachine(RuleBasedStateMachine):
    """A model that keeps announcements and interests only, and works out everything else from scratch."""

    sliced = False

    @initialize()
    def start(self) -> None:
        self.table = RoutingTable(OPEN, limits=RoutingLimits(slice_units=1) if self.sliced else None)
        self.access = OPEN
        self.streams: dict[StreamId, bool] = {}
        self.interests: dict[ClientName, tuple[tuple[str, ...], frozenset[TopicName]]] = {}
        self.boots: dict[ClientName, int] = {}
        self.next_boot = 1

    def matches(self) -> set[Match]:
        return {
            Match(client, held)
            for held in self.streams
            for client, (patterns, exact) in self.interests.items()
            if client != held.origin
            and (held.topic in exact or any(re.fullmatch(pattern, held.topic) for pattern in patterns))
            and self.access.may_subscribe(client, held.topic)
        }

    def apply(self, change: RouteChange, before: set[Match], streams_before: set[StreamId]) -> None:
        after = self.matches()
        matched, unmatched = set(change.matched), set(change.unmatched)
        while waiting := [client for client in CLIENTS if self.table.unfinished(client)]:
            assert self.sliced
            self.table.validate()
            more = self.table.go_on(waiting[-1])
            assert not (matched | unmatched) & {*more.matched, *more.unmatched}
            matched |= set(more.matched)
            unmatched |= set(more.unmatched)
        assert matched == after - before
        assert unmatched == before - after
        assert set(change.added) == self.streams.keys() - streams_before
        assert set(change.removed) == streams_before - self.streams.keys()
        if self.sliced:
            return  # the last subscriber may go in one slice, and the first come in another
        had, has = {match.stream for match in before}, {match.stream for match in after}
        assert set(change.wanted) == has - had
        assert set(change.unwanted) == (had - has) & self.streams.keys()

    @rule(client=st.sampled_from(CLIENTS), topic=st.sampled_from(TOPICS), many=st.booleans(), reboot=st.booleans())
    def announce(self, client: ClientName, topic: TopicName, many: bool, reboot: bool) -> None:
        before, streams_before = self.matches(), set(self.streams)
        if reboot or client not in self.boots:
            boot = self.next_boot
            self.next_boot += 1
        else:
            boot = self.boots[client]
        info = stream(client, topic, boot=boot, many=many)
        rivals = [held for held in self.streams if held.topic == topic and held.origin != client]
        taken = any(not (many and self.streams[held]) for held in rivals)
        if not self.access.may_publish(client, topic) or taken:
            if self.streams.get(info.id) == many:
                assert self.table.announce(info) == NO_CHANGE
            else:
                refusal(self.table, info)
            return
        change = self.table.announce(info)
        if boot != self.boots.get(client, boot):
            self.streams = {held: flag for held, flag in self.streams.items() if held.origin != client}
        self.boots[client] = boot
        self.streams[info.id] = many
        self.apply(change, before, streams_before)

    @rule(client=st.sampled_from(CLIENTS), topic=st.sampled_from(TOPICS))
    def withdraw(self, client: ClientName, topic: TopicName) -> None:
        before, streams_before = self.matches(), set(self.streams)
        held = StreamId(client, self.boots.get(client, 0), topic)
        change = self.table.withdraw(held)
        self.streams.pop(held, None)
        self.apply(change, before, streams_before)

    @rule(
        client=st.sampled_from(CLIENTS),
        patterns=st.lists(st.sampled_from(PATTERNS), max_size=2),
        exact=st.frozensets(st.sampled_from(TOPICS), max_size=2),
    )
    def subscribe(self, client: ClientName, patterns: list[str], exact: frozenset[TopicName]) -> None:
        before, streams_before = self.matches(), set(self.streams)
        change = self.table.subscribe(client, patterns, exact=exact)
        self.interests[client] = (tuple(patterns), exact)
        self.apply(change, before, streams_before)

    @rule(client=st.sampled_from(CLIENTS), topic=st.sampled_from(TOPICS))
    def also(self, client: ClientName, topic: TopicName) -> None:
        before, streams_before = self.matches(), set(self.streams)
        change = self.table.also(client, topic)
        patterns, exact = self.interests.get(client, ((), frozenset()))
        self.interests[client] = (patterns, exact | {topic})
        assert change.denied == (() if self.access.may_subscribe(client, topic) else (Denied(client, topic),))
        self.apply(change, before, streams_before)

    @rule(client=st.sampled_from(CLIENTS))
    def drop(self, client: ClientName) -> None:
        before, streams_before = self.matches(), set(self.streams)
        change = self.table.drop_client(client)
        self.interests.pop(client, None)
        self.boots.pop(client, None)
        self.streams = {held: flag for held, flag in self.streams.items() if held.origin != client}
        self.apply(change, before, streams_before)

    @rule(access=st.sampled_from(TABLES))
    def reload(self, access: AccessTable) -> None:
        before, streams_before = self.matches(), set(self.streams)
        change = self.table.set_access(access)
        self.access = access
        self.streams = {
            held: flag for held, flag in self.streams.items() if access.may_publish(held.origin, held.topic)
        }
        self.apply(change, before, streams_before)

    @invariant()
    def agrees(self) -> None:
        self.table.validate()
        assert {info.id for info in self.table.infos()} == self.streams.keys()
        found = {Match(client, held) for held in self.streams for client in self.table.subscribers(held)}
        assert found == self.matches()
        for client in CLIENTS:
            assert {Match(client, held) for held in self.table.received_by(client)} == {
                match for match in found if match.client == client
            }


class SlicedMachine(RoutingMachine):
    """Every slice is as small as can be."""

    sliced = True


@pytest.mark.parametrize("machine", [RoutingMachine, SlicedMachine])
def test_against_brute_force(machine: type[RoutingMachine]) -> None:
    run_state_machine_as_test(
        machine,
        settings=settings(max_examples=cases(40), stateful_step_count=30),
    )
