"""Names, patterns and topic rules: first match wins, namespaces go round, defaults follow the publisher."""

import re
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.topics.patterns import PatternSet, compile_pattern
from sern_core.topics.rules import (
    Auto,
    Direction,
    Discovery,
    DiscoveryMode,
    FeedRole,
    Lease,
    LossAction,
    RuleError,
    RuleSet,
    TopicRule,
)
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import KAPPA, TopicInfo, TopicSpec
from sern_core.vocabulary.names import (
    client_name,
    in_namespace,
    name_problem,
    normal_namespace,
    plain_type,
    to_global,
    to_local,
    topic_name,
)
from sern_core.vocabulary.types import Durability, Encoding, PriorityClass, Reliability, TopicName
from tests.exploring import cases

STEADY = settings(max_examples=cases(60))
PARTS = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,5}", fullmatch=True)
NAMES = st.lists(PARTS, min_size=1, max_size=4).map(lambda parts: TopicName("/" + "/".join(parts)))
FEW_NAMES = st.sampled_from([TopicName(name) for name in ("/a", "/b", "/a/b", "/odom", "/tf")])
NAMESPACES = st.just("/") | NAMES.map(str)
ZERO = Lease(LossAction.ZERO, 0.5)


def rule(match: str, **settings: object) -> TopicRule:
    return TopicRule(match=compile_pattern(match), **settings)  # type: ignore[arg-type]


def info(
    name: str, type_name: str = "std_msgs/String", *, latched: bool = False, reliable: bool | None = None
) -> TopicInfo:
    return TopicInfo(TopicName(name), type_name, Encoding.ROS1, latched=latched, reliable=reliable)


def spec(rules: RuleSet, topic: TopicInfo) -> TopicSpec:
    return rules.resolve(topic, local_name=topic.name).spec


# Names


@pytest.mark.parametrize("name", ["/a", "/a/b_1", "/_hidden", "/camera/1/image", "/A", "/" + "a" * 254])
def test_good_names(name: str) -> None:
    assert topic_name(name) == name


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("", "must start with '/'"),
        ("a", "must start with '/'"),
        ("~a", "must start with '/'"),
        ("/", "is not a ROS name"),
        ("/a/", "is not a ROS name"),
        ("//a", "is not a ROS name"),
        ("/1a", "is not a ROS name"),
        ("/a b", "is not a ROS name"),
        ("/é", "is not a ROS name"),
        ("/a\n", "is not a ROS name"),
        ("/a{b}", "is not a ROS name"),
        ("/" + "a" * 255, "is longer than 255 characters"),
    ],
)
def test_bad_names(name: str, problem: str) -> None:
    assert (name_problem(name) or "").startswith(problem)
    with pytest.raises(UsageError):
        topic_name(name)


def test_client_names() -> None:
    assert client_name("jackal_1") == "jackal_1"
    for bad in ("", "1a", "A", "a-b", "a" * 64, "a\n", "é"):
        with pytest.raises(UsageError):
            client_name(bad)


def test_namespaces_are_normal() -> None:
    assert [normal_namespace(text) for text in ("/", "a", "/a", "a/b")] == ["/", "/a", "/a", "/a/b"]
    for bad in ("", "a/", "//a", "a b"):
        with pytest.raises(UsageError):
            normal_namespace(bad)


@STEADY
@given(NAMES, NAMESPACES)
def test_namespace_round_trip(local: TopicName, namespace: str) -> None:
    name = to_global(local, namespace)
    assert name_problem(name) is None
    assert in_namespace(name, namespace)
    assert to_local(name, namespace) == local


@STEADY
@given(NAMES, NAMES)
def test_foreign_names_stay_as_they_are(name: TopicName, namespace: str) -> None:
    if not in_namespace(name, namespace):
        assert to_local(name, namespace) == name


def test_a_namespace_ends_at_a_slash() -> None:
    assert not in_namespace(TopicName("/jackal10/odom"), "/jackal1")
    assert to_local(TopicName("/jackal10/odom"), "/jackal1") == "/jackal10/odom"


# Rules


@STEADY
@given(st.lists(st.sampled_from(["/a", "/a.*", ".*", "/odom|/tf", "/b", ".*/b"]), max_size=5), FEW_NAMES)
def test_first_match_wins(matches: list[str], name: TopicName) -> None:
    # The weight says which rule was taken. A rule that an earlier one hides is refused, so those are left out.
    rules: list[TopicRule] = []
    for match in matches:
        candidate = rule(match, weight=float(len(rules) + 1))
        if candidate.plain_name is None or not any(r.match.fullmatch(candidate.plain_name) for r in rules):
            rules.append(candidate)
    resolved = RuleSet(tuple(rules)).resolve(info(name), local_name=name)
    expected = [index for index, r in enumerate(rules) if re.fullmatch(r.match.pattern, name)]
    if expected:
        assert (resolved.rule, resolved.spec.weight) == (expected[0], expected[0] + 1.0)
    else:
        assert (resolved.rule, resolved.spec) == (None, TopicSpec(many_writers=name == "/tf"))


def test_type_narrows_a_rule_in_both_spellings() -> None:
    rules = RuleSet((rule(".*", type_match=compile_pattern("sensor_msgs/.*"), depth=3), rule(".*", depth=5)))
    assert spec(rules, info("/a", "sensor_msgs/Imu")).depth == 3
    assert spec(rules, info("/a", "sensor_msgs/msg/Imu")).depth == 3
    assert spec(rules, info("/a", "std_msgs/String")).depth == 5
    ros2 = RuleSet((rule(".*", type_match=compile_pattern("sensor_msgs/msg/Imu"), depth=3),))
    assert spec(ros2, info("/a", "sensor_msgs/msg/Imu")).depth == 3
    assert plain_type("geometry_msgs/msg/Twist") == plain_type("geometry_msgs/Twist") == "geometry_msgs/Twist"


def test_unmatched_topics() -> None:
    rules = RuleSet((rule("/a"),), retention_s=7.0)
    assert spec(rules, info("/b", reliable=True)) == TopicSpec(retention_s=7.0)
    latched = spec(rules, info("/b", latched=True))
    assert (latched.durability, latched.lifespan_s, latched.reliable) == (Durability.TRANSIENT_LOCAL, None, False)


@pytest.mark.parametrize(
    ("offered", "settings", "expected"),
    [
        ({}, {}, (False, False, 1, 1.0)),
        ({"reliable": True}, {}, (True, False, 10, None)),
        ({"reliable": False}, {}, (False, False, 1, 1.0)),
        ({"latched": True}, {}, (True, True, 10, None)),
        ({"latched": True, "reliable": False}, {}, (False, True, 1, None)),
        ({"reliable": True}, {"reliability": Reliability.BEST_EFFORT}, (False, False, 1, 1.0)),
        ({}, {"reliability": Reliability.RELIABLE}, (True, False, 10, None)),
        ({}, {"reliability": Reliability.RELIABLE, "lifespan_s": 2.0, "depth": 4}, (True, False, 4, 2.0)),
        ({}, {"lifespan_s": None}, (False, False, 1, None)),
        ({"latched": True}, {"durability": Durability.VOLATILE}, (True, False, 10, None)),
    ],
)
def test_auto_copies_the_publisher(
    offered: dict[str, bool], settings: dict[str, object], expected: tuple[bool, bool, int, float | None]
) -> None:
    topic = info("/a", latched=offered.get("latched", False), reliable=offered.get("reliable"))
    got = spec(RuleSet((rule("/a", **settings),)), topic)
    assert (got.reliable, got.latched, got.depth, got.lifespan_s) == expected


@pytest.mark.parametrize(
    ("type_name", "priority", "lifespan_s"),
    [
        ("geometry_msgs/Twist", PriorityClass.CONTROL, 0.3),
        ("geometry_msgs/msg/TwistStamped", PriorityClass.CONTROL, 0.3),
        ("geometry_msgs/Twist", PriorityClass.STATE, None),
        ("nav_msgs/Odometry", PriorityClass.CONTROL, None),
    ],
)
def test_commands_are_short_lived_even_if_reliable(
    type_name: str, priority: PriorityClass, lifespan_s: float | None
) -> None:
    got = spec(RuleSet((rule("/a", priority=priority),)), info("/a", type_name, reliable=True))
    assert (got.priority, got.weight, got.lifespan_s) == (priority, KAPPA[priority], lifespan_s)


def test_explicit_lifespan_of_a_command_holds() -> None:
    twist = info("/a", "geometry_msgs/Twist")
    assert spec(RuleSet((rule("/a", priority=PriorityClass.CONTROL, lifespan_s=2.0),)), twist).lifespan_s == 2.0
    auto = rule("/a", priority=PriorityClass.CONTROL, lifespan_s=Auto.AUTO)
    assert spec(RuleSet((auto,)), twist).lifespan_s == 0.3


def test_on_link_loss_is_for_velocity_commands_only() -> None:
    rules = RuleSet((rule("/cmd_vel|/odom", lease=ZERO),))
    name = TopicName("/cmd_vel")
    for known in ("geometry_msgs/Twist", "geometry_msgs/msg/TwistStamped", ""):
        assert rules.resolve(info("/cmd_vel", known), local_name=name).lease == ZERO
    with pytest.raises(ConfigError) as caught:
        rules.resolve(info("/odom", "nav_msgs/Odometry"), local_name=TopicName("/odom"))
    assert str(caught.value) == (
        "topics.0.on_link_loss: /odom is nav_msgs/Odometry; on_link_loss can publish only geometry_msgs/Twist, "
        "geometry_msgs/TwistStamped"
    )


def test_many_writers_by_convention() -> None:
    rules = RuleSet((rule("/tf_static|/a"), rule("/b|/tf", many_writers=False), rule("/c", many_writers=True)))
    wanted = {"/tf_static": True, "/a": False, "/tf": False, "/b": False, "/c": True}
    assert {name: spec(rules, info(name)).many_writers for name in wanted} == wanted


# Remap and subscriptions


@STEADY
@given(st.lists(FEW_NAMES, unique=True, max_size=3), NAMESPACES, FEW_NAMES)
def test_outward_and_inward_are_inverse(sources: list[TopicName], namespace: str, name: TopicName) -> None:
    rules = RuleSet(tuple(rule(source, remap=TopicName(f"/new{index}")) for index, source in enumerate(sources)))
    outward = rules.outward(info(name), local_name=name, namespace=namespace)
    assert in_namespace(outward, namespace)
    assert rules.inward(outward, namespace=namespace) == name


def test_remap_names() -> None:
    rules = RuleSet((rule("/goal", remap=TopicName("/target")), rule(".*")))
    goal = TopicName("/goal")
    assert rules.outward(info("/goal"), local_name=goal, namespace="/j") == "/j/target"
    assert rules.inward(TopicName("/j/target"), namespace="/j") == "/goal"
    assert rules.inward(TopicName("/k/target"), namespace="/j") == "/k/target"
    assert rules.inward(TopicName("/target"), namespace="/j") == "/target"
    with pytest.raises(ConfigError, match=r"^/target is .* also the new name that `remap` gives to /goal$"):
        rules.resolve(info("/target"), local_name=TopicName("/target"))
    swapped = RuleSet((rule("/a", remap=TopicName("/b")), rule("/b", remap=TopicName("/a"))))
    assert swapped.outward(info("/a"), local_name=TopicName("/a"), namespace="/") == "/b"
    assert swapped.inward(TopicName("/b"), namespace="/") == "/a"


@pytest.mark.parametrize(
    ("rules", "index", "field"),
    [
        ((rule("/a.*", remap=TopicName("/b")),), 0, "remap"),
        ((rule("/a", remap=TopicName("/b"), type_match=compile_pattern(".*")),), 0, "remap"),
        ((rule("/a", remap=TopicName("/c")), rule("/b", remap=TopicName("/c"))), 1, "remap"),
        ((rule(".*"), rule("/a")), 1, "match"),
        ((rule("/a"), rule("/a")), 1, "match"),
        ((rule(".*", type_match=compile_pattern("x")), rule("/a", remap=TopicName("/b"))), 1, "match"),
    ],
)
def test_rules_that_can_not_work_together(rules: tuple[TopicRule, ...], index: int, field: str) -> None:
    with pytest.raises(RuleError) as caught:
        RuleSet(rules)
    assert (caught.value.index, caught.value.field) == (index, field)


def test_a_rule_for_one_type_hides_nothing() -> None:
    RuleSet((rule(".*", type_match=compile_pattern("x")), rule("/a")))


def test_receive_rules_become_patterns_of_global_names() -> None:
    rules = RuleSet(
        (
            rule("/cmd_vel|/goal", direction=Direction.RECEIVE),
            rule("/in", direction=Direction.RECEIVE, remap=TopicName("/out")),
            rule("/both", direction=Direction.BOTH),
        )
    )
    patterns = rules.receive_patterns("/j")
    assert all(PatternSet(patterns).fullmatch(name) for name in ("/j/cmd_vel", "/j/goal", "/j/out"))
    assert not any(
        PatternSet(patterns).fullmatch(name) for name in ("/cmd_vel", "/j/in", "/j/both", "/k/goal", "/goal")
    )
    assert PatternSet(rules.receive_patterns("/")).fullmatch("/goal")


def test_directions() -> None:
    assert [(d.sends, d.receives) for d in Direction] == [(True, False), (False, True), (True, True)]


# Discovery and feed


@pytest.mark.parametrize(
    ("mode", "name", "listed", "wanted"),
    [
        (DiscoveryMode.DYNAMIC, "/a", False, True),
        (DiscoveryMode.DYNAMIC, "/a", True, True),
        (DiscoveryMode.MANUAL, "/a", False, False),
        (DiscoveryMode.MANUAL, "/a", True, True),
        (DiscoveryMode.DYNAMIC, "/a/secret", True, False),  # deny wins over allow and over a rule
        (DiscoveryMode.DYNAMIC, "/b", True, False),  # not allowed
    ],
)
def test_discovery(mode: DiscoveryMode, name: str, listed: bool, wanted: bool) -> None:
    discovery = Discovery(mode, allow=(compile_pattern("/a.*"),), deny=(compile_pattern(".*/secret"),))
    assert discovery.wants(TopicName(name), "std_msgs/msg/String", listed=listed) is wanted


@pytest.mark.parametrize(
    ("type_name", "wanted"),
    [
        ("sensor_msgs/msg/Imu", True),
        ("sensor_msgs/Imu", True),
        ("sensor_msgs/msg/Image", False),  # denied wins over allowed
        ("sensor_msgs/Image", False),
        ("std_msgs/msg/String", False),  # not allowed
    ],
)
def test_discovery_by_type(type_name: str, wanted: bool) -> None:
    discovery = Discovery(
        DiscoveryMode.DYNAMIC,
        allow_types=(compile_pattern("sensor_msgs/.*"),),
        deny_types=(compile_pattern("sensor_msgs/(Compressed)?Image"),),
    )
    for listed in (False, True):
        assert discovery.wants(TopicName("/a"), type_name, listed=listed) is wanted


def test_feed_roles_deny_by_default() -> None:
    role = FeedRole("viewer", "tcp://127.0.0.1:5570")
    assert not role.may_see(TopicName("/a"))
    assert not role.may_publish(TopicName("/a"), PriorityClass.BULK)
    commander = FeedRole("c", "x", "y", publish=(compile_pattern("/a"),), allow_control=True)
    assert commander.may_publish(TopicName("/a"), PriorityClass.CONTROL)


@pytest.mark.parametrize(
    ("name", "type_name", "rule", "merged"),
    [
        ("/tf", "tf2_msgs/msg/TFMessage", None, False),
        ("/tf_static", "tf2_msgs/msg/TFMessage", None, True),
        ("/robot1/tf_static", "tf/msg/tfMessage", {"priority": PriorityClass.BULK}, True),
        ("/tf_static", "tf2_msgs/msg/TFMessage", {"merge_tf": False}, False),
        ("/tf", "tf2_msgs/msg/TFMessage", {"priority": PriorityClass.STATE}, True),
        ("/tf", "tf2_msgs/msg/TFMessage", {"priority": PriorityClass.CONTROL}, False),
        ("/tf", "tf2_msgs/msg/TFMessage", {"priority": PriorityClass.CONTROL, "merge_tf": True}, True),
        (
            "/tf",
            "tf2_msgs/msg/TFMessage",
            {"priority": PriorityClass.STATE, "reliability": Reliability.RELIABLE},
            False,
        ),
        ("/odom", "nav_msgs/msg/Odometry", {"priority": PriorityClass.STATE, "merge_tf": True}, False),
    ],
)
def test_which_transforms_are_merged(name: str, type_name: str, rule: dict[str, Any] | None, merged: bool) -> None:
    rules = RuleSet(() if rule is None else (TopicRule(compile_pattern(".*"), **rule),))
    info = TopicInfo(TopicName(name), type_name, Encoding.CDR)
    assert rules.resolve(info, local_name=info.name).merge_tf is merged


@pytest.mark.parametrize(
    ("type_name", "reckoned"),
    [("nav_msgs/msg/Odometry", True), ("nav_msgs/Odometry", True), ("geometry_msgs/msg/PoseStamped", False)],
)
def test_dead_reckoning_is_for_odometry(type_name: str, reckoned: bool) -> None:
    info = TopicInfo(TopicName("/odom"), type_name, Encoding.CDR, "")
    rule = TopicRule(compile_pattern("/odom"), dead_reckoning=True)
    assert RuleSet((rule,)).resolve(info, local_name=info.name).dead_reckoning is reckoned
    assert not RuleSet((TopicRule(compile_pattern("/odom")),)).resolve(info, local_name=info.name).dead_reckoning
