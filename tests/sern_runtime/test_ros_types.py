"""Names, definitions and hashes of message types, and the bodies built from them."""

import pytest
from rosbags.typesys import Stores, get_typestore

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

ROS1, CDR = Encoding.ROS1, Encoding.CDR


@pytest.mark.parametrize(
    ("given", "long", "short"),
    [
        ("nav_msgs/Odometry", "nav_msgs/msg/Odometry", "nav_msgs/Odometry"),
        ("nav_msgs/msg/Odometry", "nav_msgs/msg/Odometry", "nav_msgs/Odometry"),
        ("std_srvs/srv/Trigger", "std_srvs/srv/Trigger", "std_srvs/Trigger"),
    ],
)
def test_names(given: str, long: str, short: str) -> None:
    assert ros_types.canonical(given) == long
    assert ros_types.ros1_name(given) == short


@pytest.mark.parametrize("name", ["", "Odometry", "a/b/c/d", "nav_msgs/Odo metry", "*", "nav_msgs/topic/Odometry"])
def test_names_that_are_none(name: str) -> None:
    with pytest.raises(ConfigError):
        ros_types.canonical(name)


@pytest.mark.parametrize(
    ("name", "md5"),
    [
        ("std_msgs/msg/String", "992ce8a1687cec8c8bd883ec73ca41d1"),
        ("nav_msgs/msg/Odometry", "cd5e73d190d741a2f92e81eda573aca7"),
        ("sensor_msgs/msg/Imu", "6a62c6daae103f4ff57a132d6f95cec2"),
        ("geometry_msgs/msg/Twist", "9f195f881246fdfa2798d1d3eebca84a"),
        ("tf2_msgs/msg/TFMessage", "94810edda583a504dfda3829e70d7eec"),
        ("map_msgs/msg/OccupancyGridUpdate", "b295be292b335c34718bd939deebe1c9"),
    ],
)
def test_md5_as_ros_gives_it(name: str, md5: str) -> None:
    text = ros_types.describe(name, ROS1)
    assert text is not None and text.type_hash == md5
    assert ros_types.hash_of(name, text.definition, ROS1) == md5


@pytest.mark.parametrize("encoding", [ROS1, CDR])
def test_every_known_type_is_consistent(encoding: Encoding) -> None:
    """The hash worked out of a definition text equals the typestore's; a zero message survives the round trip."""
    fresh = get_typestore(
        Stores.ROS1_NOETIC if encoding is ROS1 else Stores.ROS2_JAZZY
    )  # without what others registered
    for name in fresh.fielddefs:
        text = ros_types.describe(name, encoding)
        assert text is not None
        assert ros_types.hash_of(name, text.definition, encoding) == text.type_hash
        body = ros_types.serialise(ros_types.new(name, encoding), name, encoding)
        again = ros_types.serialise(ros_types.deserialise(body, name, encoding), name, encoding)
        assert again == body


def test_md5_counts_constants_as_they_are_spelt() -> None:
    """Expected value: the rule of the ROS 1 technical overview, by hand."""
    from hashlib import md5

    definition = "# a comment\nuint8 MASK = 0x0F  # hex\nstring NAME= a # b \nfloat32   value\nHeader header\n"
    header = "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    expected = "uint8 MASK=0x0F\nstring NAME=a # b\nfloat32 value\n2176decaecbce78abc3b96ef049fabed header"
    assert ros_types.hash_of("my_msgs/msg/Thing", definition + header, ROS1) == md5(expected.encode()).hexdigest()


@pytest.mark.parametrize("encoding", [ROS1, CDR])
def test_stop_command(encoding: Encoding) -> None:
    for name in ("geometry_msgs/msg/Twist", "geometry_msgs/TwistStamped"):
        body = ros_types.zero_message(name, encoding)
        assert body is not None
        message = ros_types.deserialise(body, ros_types.canonical(name), encoding)
        twist = message.twist if "Stamped" in name else message
        assert (twist.linear.x, twist.linear.y, twist.angular.z) == (0.0, 0.0, 0.0)
    assert ros_types.zero_message("std_msgs/msg/Float64", encoding) is None
    assert ros_types.zero_message("geometry_msgs/msg/Twist", Encoding.RAW) is None


def test_register_a_type_that_came_with_its_topic() -> None:
    name, text = "my_robot_msgs/msg/Gait", "uint8 WALK=1\nuint8 mode\nfloat64[4] legs\nmy_robot_msgs/Foot[] feet\n"
    text += "=" * 80 + "\nMSG: my_robot_msgs/Foot\nfloat32 load\n"
    with pytest.raises(ConfigError, match="unknown here"):
        ros_types.deserialise(b"", name, CDR)
    for encoding in (ROS1, CDR):
        assert ros_types.describe(name, encoding) is None
        ros_types.register(name, text, encoding)
        ros_types.register(name, text, encoding)  # again is harmless
        body = ros_types.serialise(ros_types.new(name, encoding, mode=3), name, encoding)
        assert ros_types.deserialise(body, name, encoding).mode == 3
        with pytest.raises(ConfigError, match="differs from the known"):
            ros_types.register(name, "int64 other\n", encoding)


@pytest.mark.parametrize(
    ("definition", "said"),
    [
        ("not { a definition", "cannot be parsed"),
        ("my_msgs/Missing part\n", "does not define"),
        ("x" * (2**20 + 1), "too large"),
        ("A a\n" + "=" * 80 + "\nMSG: my_msgs/A\nmy_msgs/A a\n", "contains itself"),
    ],
)
@pytest.mark.parametrize("encoding", [ROS1, CDR])
def test_definitions_that_are_none(definition: str, said: str, encoding: Encoding) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        ros_types.hash_of("my_msgs/msg/Bad", definition, encoding)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_bodies_that_do_not_fit() -> None:
    for encoding in (ROS1, CDR):
        with pytest.raises(ConfigError, match="do not decode"):
            ros_types.deserialise(b"\x00\x01\x00\x00\x05", "nav_msgs/msg/Odometry", encoding)
    with pytest.raises(UsageError, match="has no field"):
        ros_types.new("std_msgs/msg/String", ROS1, text="x")
    with pytest.raises(ConfigError, match="raw"):
        ros_types.typestore(Encoding.RAW)
    with pytest.raises(ConfigError, match="unknown here"):
        ros_types.topic_info("/x", "no_msgs/msg/Such", ROS1)
