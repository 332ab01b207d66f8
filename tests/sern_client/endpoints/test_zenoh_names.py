"""What rmw_zenoh calls things; no session."""

import pytest

from sern_client.endpoints.zenoh import names
from sern_client.endpoints.zenoh.names import Kind, Qos
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import TopicName

TOKEN = (
    "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MP/%/%robot/talker/%robot%chatter/"
    "std_msgs::msg::dds_::String_/RIHS01_df66/::,7:,:,:,,"
)


def test_a_token_of_a_publisher() -> None:
    entity = names.parse_token(TOKEN)
    assert entity.session == "aac3178e146ba6f1fc6e6a4085e77f21"
    assert (entity.kind, entity.node, entity.name) == (Kind.PUBLISHER, "/robot/talker", "/robot/chatter")
    assert names.ros_type(entity.dds_type) == "std_msgs/msg/String"
    assert Qos.decode(entity.qos) == Qos(True, False, 7)
    assert entity.enclave == "/" and not entity.bridged
    other = names.parse_token(TOKEN.replace("/0/10/MP", "/0/11/MP"))
    assert other.key != entity.key


def test_what_we_write_can_be_read() -> None:
    token = names.entity_token(
        3, "abc", 5, Kind.SERVER, "sern", names.ENCLAVE, name=TopicName("/a/b"), dds_name=names.dds_type("x/srv/Y"),
        type_hash="RIHS01_1", qos=Qos(False, True, 3),
    )  # fmt: skip
    entity = names.parse_token(token)
    assert (entity.session, entity.kind, entity.node, entity.name) == ("abc", Kind.SERVER, "/sern", "/a/b")
    assert (names.ros_type(entity.dds_type), entity.type_hash) == ("x/srv/Y", "RIHS01_1")
    assert Qos.decode(entity.qos) == Qos(False, True, 3)
    node = names.parse_token(names.node_token(3, "abc", "sern", names.ENCLAVE))
    assert (node.kind, node.node) == (Kind.NODE, "/sern")
    assert entity.bridged and node.bridged, "others of ours know them by their enclave"
    first, second, other = (names.new_gid(enclave) for enclave in (names.ENCLAVE, names.ENCLAVE, "/"))
    assert first != second and len(first) == len(other) == names.GID_BYTES
    assert [gid.startswith(names.GID_MARK) for gid in (first, second, other)] == [True, True, False]


@pytest.mark.parametrize(
    "token",
    [
        "",
        "@ros2_lv",
        TOKEN + "/more",
        TOKEN.replace("MP", "XX"),
        TOKEN.replace("MP", "NN"),
        TOKEN.replace("%robot%chatter", "%ro bot"),
        TOKEN.replace("%robot%chatter", "%" + "a" * 300),
    ],
)
def test_what_is_no_token_is_refused(token: str) -> None:
    with pytest.raises(WireError):
        names.parse_token(token)


@pytest.mark.parametrize("text", ["", "2", "::,x:,", "::1,9999999999999999999x:"])
def test_what_is_no_quality_of_service_is_refused(text: str) -> None:
    with pytest.raises(WireError):
        Qos.decode(text)


def test_depths_stay_within_reason() -> None:
    assert Qos.decode("::,0:,:,:,,").depth == 1
    assert Qos.decode("::,99999999999:,:,:,,").depth == 10_000
    assert Qos.decode("::2,:,:,:,,").depth == names.DEFAULT_DEPTH


@pytest.mark.parametrize("name", ["String", "std_msgs::msg::String_", "a::b::dds_::C_", "std_msgs::msg::dds_::_"])
def test_what_is_no_type_is_refused(name: str) -> None:
    with pytest.raises(WireError):
        names.ros_type(name)


def test_attachments() -> None:
    gid = bytes(range(16))
    packed = names.pack_attachment(5, 1_700_000_000_000_000_000, gid)
    assert len(packed) == 33
    assert names.unpack_attachment(packed) == (5, 1_700_000_000_000_000_000, gid)
    for bad in (b"", packed[:-1], packed + b"x", packed[:16] + b"\x0f" + packed[17:]):
        with pytest.raises(WireError):
            names.unpack_attachment(bad)
