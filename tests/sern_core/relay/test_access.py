"""Access rules: default deny, `{self}`, first rule wins, reloads, rate guard, and patterns that peers send."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.relay.access import CACHE_ENTRIES, AccessRule, AccessTable, ClientLimits, LostAccess, RateGuard, Right
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.types import ClientName, TopicName
from tests.exploring import cases

PURE = settings(max_examples=cases(60))

RULES = (
    AccessRule("operator", publish=("/.*/cmd_vel",), subscribe=(".*",), replay=("/map",)),
    AccessRule("jackal[0-9]+", publish=("/{self}/.*", "/tf|/tf_static"), subscribe=("/{self}/cmd_vel", "/map")),
    AccessRule("jackal.*", publish=(".*",)),
)


@pytest.mark.parametrize(
    ("client", "topic", "publish", "subscribe", "replay"),
    [
        ("operator", "/jackal1/cmd_vel", True, True, False),
        ("operator", "/map", False, True, True),
        ("operator", "/cmd_vel", False, True, False),
        ("jackal1", "/jackal1/odom", True, False, False),
        ("jackal1", "/jackal1/cmd_vel", True, True, True),  # replay follows subscribe
        ("jackal1", "/jackal10/odom", False, False, False),  # {self} is the whole name
        ("jackal1", "/tf", True, False, False),
        ("jackal1", "/tf_static", True, False, False),
        ("jackal1", "/tf/x", False, False, False),  # full match
        ("jackal1", "/jackal1", False, False, False),
        ("jackal1", "/secret", False, False, False),  # the first rule holds, the wider one below does not add to it
        ("jackal", "/secret", True, False, False),
        ("stranger", "/map", False, False, False),  # default deny
        ("operators", "/map", False, False, False),
        ("operator", "/" + "a" * 255, False, False, False),  # longer than any topic name
    ],
)
def test_decisions(client: str, topic: str, publish: bool, subscribe: bool, replay: bool) -> None:
    table = AccessTable(RULES)
    for _ in range(2):  # decided, then remembered
        assert table.may_publish(ClientName(client), TopicName(topic)) is publish
        assert table.may_subscribe(ClientName(client), TopicName(topic)) is subscribe
        assert table.may_replay(ClientName(client), TopicName(topic)) is replay


def test_no_rules_means_nothing() -> None:
    table = AccessTable()
    assert not any(table.allows(right, ClientName("a"), TopicName("/x")) for right in Right)
    assert table.limits(ClientName("a")) == ClientLimits()


def test_self_is_literal() -> None:
    table = AccessTable([AccessRule(".*", publish=("/{self}/x",))])
    assert table.may_publish(ClientName("a.b"), TopicName("/a.b/x"))
    assert not table.may_publish(ClientName("a.b"), TopicName("/acb/x"))


def test_replay_needs_subscribe_too() -> None:
    table = AccessTable([AccessRule("a", replay=(".*",))])
    assert not table.may_replay(ClientName("a"), TopicName("/x"))


@pytest.mark.parametrize(
    ("rule", "line"),
    [
        (AccessRule("("), "access[1].client: pattern '(' is not a regular expression"),
        (AccessRule("a", publish=("/ok", "/[")), "access[1].publish[1]: pattern '/[' is not a regular expression"),
        (AccessRule("a", subscribe=("*",)), "access[1].subscribe[0]: pattern '*' is not"),
        (AccessRule("a", replay=(r"/\{self}",)), r"access[1].replay[0]: pattern '/\\{self}' is not"),
        (AccessRule("a", publish=("",)), "access[1].publish[0]: pattern '' is empty"),
        (AccessRule("a", max_rate_hz=0.0), "access[1].max_rate_hz: 0.0 is not a limit"),
        (AccessRule("a", max_bytes_per_s=float("nan")), "access[1].max_bytes_per_s: nan is not a limit"),
        (AccessRule("a", max_queue_bytes=-1), "access[1].max_queue_bytes: -1 is not a limit"),
    ],
)
def test_bad_rules_are_named(rule: AccessRule, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        AccessTable([AccessRule("fine"), rule])
    assert str(caught.value).startswith(line)
    assert "\n" not in str(caught.value)


def test_limits_are_those_of_the_clients_rule() -> None:
    table = AccessTable([AccessRule("robot", max_rate_hz=5.0), AccessRule(".*", max_rate_hz=1.0, max_queue_bytes=10)])
    assert table.limits(ClientName("robot")) == ClientLimits(max_rate_hz=5.0)
    assert table.limits(ClientName("other")) == ClientLimits(max_rate_hz=1.0, max_queue_bytes=10)


def test_cache_is_bounded() -> None:
    table = AccessTable([AccessRule("a", publish=("/t1",))])
    for number in range(CACHE_ENTRIES + 10):
        table.may_publish(ClientName("a"), TopicName(f"/t{number}"))
    assert len(table._cache) <= CACHE_ENTRIES
    assert table.may_publish(ClientName("a"), TopicName("/t1"))


def test_reload_tells_what_was_lost() -> None:
    a, x, y = ClientName("a"), TopicName("/x"), TopicName("/y")
    old = AccessTable([AccessRule("a", publish=("/x",), subscribe=(".*",))])
    reload = old.replaced([AccessRule("a", publish=("/y",), subscribe=("/x",))], [(a, x), (a, y), (a, x)])
    assert reload.lost == (
        LostAccess(a, x, Right.PUBLISH),
        LostAccess(a, y, Right.SUBSCRIBE),
        LostAccess(a, y, Right.REPLAY),
    )
    assert reload.table.may_publish(a, y) and not reload.table.may_publish(a, x)
    assert old.may_publish(a, x)


def test_bad_reload_keeps_the_old_table() -> None:
    old = AccessTable([AccessRule("a", publish=("/x",))])
    with pytest.raises(ConfigError):
        old.replaced([AccessRule("a", publish=("(",))])
    assert old.may_publish(ClientName("a"), TopicName("/x"))


# Rate guard ----------------------------------------------------------------------------------------------------------


def test_guard_without_limits_admits_everything() -> None:
    guard = RateGuard.of(ClientLimits(), now=0.0)
    assert all(guard.admit(10**9, now=0.0) for _ in range(100))
    assert guard.ready_in_s(10**9, now=0.0) == 0.0


def test_guard_limits_messages() -> None:
    guard = RateGuard(max_rate_hz=10.0, burst_s=0.2, now=0.0)
    assert [guard.admit(1, now=0.0) for _ in range(3)] == [True, True, False]
    assert guard.ready_in_s(1, now=0.0) == pytest.approx(0.1)
    assert not guard.admit(1, now=0.05)
    assert guard.admit(1, now=0.1)
    assert not guard.admit(1, now=0.0)  # a clock that runs backwards earns nothing


def test_guard_slows_what_is_larger_than_its_bucket() -> None:
    guard = RateGuard(max_bytes_per_s=1000.0, burst_s=1.0, now=0.0)
    assert guard.admit(5000, now=0.0)
    assert not guard.admit(1, now=4.0)
    assert guard.ready_in_s(5000, now=4.0) == pytest.approx(1.0)
    assert guard.admit(5000, now=5.0)


@pytest.mark.parametrize("bad", [0.0, -1.0, float("inf"), float("nan")])
def test_guard_refuses_senseless_rates(bad: float) -> None:
    with pytest.raises(UsageError, match="positive"):
        RateGuard(max_rate_hz=bad, now=0.0)


@PURE
@given(
    offers=st.lists(st.tuples(st.floats(0, 0.5), st.integers(0, 4000)), max_size=100),
    bytes_per_s=st.floats(100, 10_000),
    rate_hz=st.floats(0.5, 50),
)
def test_guard_never_passes_more_than_the_rate_allows(
    offers: list[tuple[float, int]], bytes_per_s: float, rate_hz: float
) -> None:
    guard = RateGuard(max_bytes_per_s=bytes_per_s, max_rate_hz=rate_hz, burst_s=1.0, now=0.0)
    now, passed_bytes, passed = 0.0, 0, 0
    for gap_s, size_bytes in offers:
        now += gap_s
        wait_s = guard.ready_in_s(size_bytes, now=now)
        admitted = guard.admit(size_bytes, now=now)
        assert admitted == (wait_s == 0.0)
        passed_bytes += size_bytes * admitted
        passed += admitted
        assert passed_bytes <= bytes_per_s * (now + 1.0) + 4000 + 1e-6
        assert passed <= rate_hz * now + max(1.0, rate_hz) + 1e-6
        if not admitted:
            assert guard.ready_in_s(size_bytes, now=now + wait_s + 1e-9) <= 1e-6


def test_who_may_command_may_ask_and_is_told_and_nobody_else() -> None:
    site, robot, other = ClientName("site1"), ClientName("robot1"), ClientName("other")
    table = AccessTable(
        [
            AccessRule(client=site, publish=("/robot1/cmd_vel",), subscribe=("/robot1/pose",)),
            AccessRule(client=robot, publish=("/robot1/.*",), subscribe=("/robot1/cmd_vel",)),
        ]
    )
    for below in ("/take", "/release"):
        asked = TopicName(f"/robot1/cmd_vel{below}")
        assert table.may_publish(site, asked) and table.may_subscribe(robot, asked)
        assert not table.may_publish(other, asked) and not table.may_subscribe(site, asked)
        assert not table.may_publish(site, TopicName(f"/robot1/pose{below}"))
        assert not table.may_replay(robot, asked)
    holder = TopicName("/robot1/cmd_vel/holder")
    assert table.may_subscribe(site, holder) and table.may_replay(site, holder) and not table.may_publish(site, holder)
    assert not table.may_subscribe(other, holder)


# What was kept of a topic


KEPT = AccessTable(
    [
        AccessRule("robot1", publish=("/robot1/.*",)),
        AccessRule("site1", subscribe=("/robot1/points",)),
        AccessRule("site2", subscribe=("/robot1/.*",), replay=()),
        AccessRule("site3", subscribe=("/robot1/odom",)),
    ]
)


@pytest.mark.parametrize("client", ["robot1", "site1", "site2", "site3", "stranger"])
@pytest.mark.parametrize("suffix", ["_kept", "_fetch/site1", "_fetched/site1", "_fetch/site3", "_fetched/robot1"])
def test_who_may_have_a_topic_may_fetch_it_for_itself_and_nobody_else(client: str, suffix: str) -> None:
    """The robot says what it has and answers; site1 may have the topic, site2 not its earlier messages, site3 not at
    all. None of them sees what another one asks for or gets."""
    name, who = TopicName(f"/robot1/points/{suffix}"), ClientName(client)
    robot, asks = client == "robot1", suffix.startswith("_fetch/")
    site = client == "site1" and suffix in ("_kept", "_fetch/site1", "_fetched/site1")
    assert KEPT.may_publish(who, name) is (site if asks else robot)
    assert KEPT.may_subscribe(who, name) is (robot if asks else site)
    assert KEPT.may_replay(who, name) is (robot if asks else site)


def test_a_rule_for_the_names_themselves_gives_nothing() -> None:
    table = AccessTable([AccessRule("site1", publish=("/robot1/points/.*",), subscribe=("/robot1/points/.*",))])
    for suffix in ("_kept", "_fetch/site1", "_fetched/site1"):
        name = TopicName(f"/robot1/points/{suffix}")
        assert not table.may_publish(ClientName("site1"), name) and not table.may_subscribe(ClientName("site1"), name)
