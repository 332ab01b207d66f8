"""Merged transforms: the newest of each pair, none twice, none stale; static ones complete."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_core.summaries.transforms import StaticTransforms, TransformMerger, read_transforms, write_transforms
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from tests.sern_core.summaries import scenes

CDR = Encoding.CDR


def transform(parent: str, child: str, stamp_s: float, x_m: float = 0.0, encoding: Encoding = CDR) -> Any:
    vector = ros_types.new("geometry_msgs/msg/Vector3", encoding, x=x_m, y=2.0, z=-3.0)
    turn = ros_types.new("geometry_msgs/msg/Quaternion", encoding, x=0.0, y=0.6, z=0.0, w=0.8)
    return ros_types.new(
        "geometry_msgs/msg/TransformStamped",
        encoding,
        header=ros_types.header(round(stamp_s * 1e9), parent, encoding, 4),
        child_frame_id=child,
        transform=ros_types.new("geometry_msgs/msg/Transform", encoding, translation=vector, rotation=turn),
    )


def message(*transforms: Any, encoding: Encoding = CDR) -> bytes:
    return scenes.write(ros_types.new(scenes.TF, encoding, transforms=list(transforms)), scenes.TF, encoding)


def pairs(body: bytes | None, encoding: Encoding = CDR) -> dict[tuple[str, str], float]:
    """x by pair of frames, as rosbags reads it; no pair is in it twice."""
    assert body is not None
    found = scenes.read(body, scenes.TF, encoding).transforms
    result = {(t.header.frame_id, t.child_frame_id): t.transform.translation.x for t in found}
    assert len(result) == len(found)
    return result


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_transforms_are_laid_out_as_rosbags_says(encoding: Encoding) -> None:
    for count in range(4):
        body = message(*(transform("o" * i, "b", i + 0.25, i, encoding) for i in range(count)), encoding=encoding)
        transforms = read_transforms(body, encoding)
        assert len(transforms) == count
        assert write_transforms(transforms, encoding) == body
    assert transforms[2].header.stamp_ns == 2_250_000_000 and transforms[2].rotation == (0.0, 0.6, 0.0, 0.8)


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_many_messages_become_one_with_the_newest_of_each_pair(encoding: Encoding) -> None:
    merger = TransformMerger(encoding)
    for step in range(10):
        now = step * 0.01
        merger.add(message(transform("odom", "base", 1 + now, step, encoding), encoding=encoding), now=now)
        wheels = [transform("base", f"wheel{i}", 1 + now, 10 * i + step, encoding) for i in range(4)]
        merger.add(message(*wheels, encoding=encoding), now=now)
    merger.add(message(transform("map", "odom", 0.5, 7, encoding), encoding=encoding), now=0.1)
    assert len(merger) == 6 and merger.superseded == 45
    body = merger.take(now=0.1)
    assert pairs(body, encoding) == {
        ("odom", "base"): 9,
        **{("base", f"wheel{i}"): 10 * i + 9 for i in range(4)},
        ("map", "odom"): 7,
    }
    assert merger.take(now=0.2) is None  # nothing is sent twice


def test_an_older_stamp_does_not_replace_a_newer_one_but_a_restarted_clock_is_no_fault() -> None:
    merger = TransformMerger(CDR)
    merger.add(message(transform("o", "b", 5.0, 1)), now=0)
    merger.add(message(transform("o", "b", 4.9, 2)), now=0)
    merger.add(message(transform("o", "b", 5.0, 3)), now=0)
    assert pairs(merger.take(now=0)) == {("o", "b"): 3}
    merger.add(message(transform("o", "b", 0.0, 4)), now=1)
    assert pairs(merger.take(now=1)) == {("o", "b"): 4}


def test_two_parents_of_one_child_are_two_pairs() -> None:
    merger = TransformMerger(CDR)
    merger.add(message(transform("a", "b", 1.0, 1), transform("c", "b", 1.0, 2)), now=0)
    assert pairs(merger.take(now=0)) == {("a", "b"): 1, ("c", "b"): 2}


def test_what_waited_too_long_is_left_out() -> None:
    merger = TransformMerger(CDR)
    merger.add(message(transform("a", "b", 1.0)), now=0.0)
    merger.add(message(transform("a", "c", 1.0, 5)), now=0.9)
    assert pairs(merger.take(now=1.5, lifespan_s=1.0)) == {("a", "c"): 5}
    merger.add(message(transform("a", "b", 1.0)), now=2.0)
    assert merger.take(now=3.5, lifespan_s=1.0) is None and merger.superseded == 2


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_static_transforms_of_several_publishers_add_up(encoding: Encoding) -> None:
    static = StaticTransforms(encoding)
    first = static.add(message(transform("base", "lidar", 1, 1, encoding), encoding=encoding))
    assert pairs(first, encoding) == {("base", "lidar"): 1}
    second = static.add(
        message(
            transform("base", "camera", 1, 2, encoding), transform("camera", "optical", 1, 3, encoding),
            encoding=encoding,
        )
    )  # fmt: skip
    assert pairs(second, encoding) == {("base", "lidar"): 1, ("base", "camera"): 2, ("camera", "optical"): 3}
    again = message(transform("base", "lidar", 9, 1, encoding), encoding=encoding)
    assert static.add(again) is None  # another stamp of the same is nothing new
    moved = static.add(message(transform("mast", "lidar", 9, 4, encoding), encoding=encoding))
    assert pairs(moved, encoding) == {("mast", "lidar"): 4, ("base", "camera"): 2, ("camera", "optical"): 3}
    assert len(static) == 3


def test_too_many_frames_are_refused_and_nothing_is_lost() -> None:
    static, merger = StaticTransforms(CDR), TransformMerger(CDR)
    many = message(*(transform("a", f"f{i}", 1) for i in range(4096)))
    assert static.add(many) is not None
    merger.add(many, now=0)
    one = message(transform("a", "one_more", 1))
    with pytest.raises(BodyError, match="4096"):
        static.add(one)
    with pytest.raises(BodyError, match="4096"):
        merger.add(one, now=0)
    assert len(static) == len(merger) == 4096


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_every_shortened_body_is_refused(encoding: Encoding) -> None:
    body = message(transform("odom", "base", 1, 0, encoding), transform("odom", "b", 1, 0, encoding), encoding=encoding)
    for size in range(len(body)):
        with pytest.raises(BodyError):
            read_transforms(body[:size], encoding)
    with pytest.raises(BodyError, match="left over"):
        read_transforms(body + bytes(8), encoding)


@given(st.binary(max_size=300), st.sampled_from(scenes.ENCODINGS))
def test_any_bytes_are_transforms_or_refused(noise: bytes, encoding: Encoding) -> None:
    head = b"" if encoding is Encoding.ROS1 else b"\0\1\0\0"
    try:
        transforms = read_transforms(head + noise, encoding)
    except BodyError:
        return
    assert len(read_transforms(write_transforms(transforms, encoding), encoding)) == len(transforms)


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 3), st.integers(0, 50), st.booleans())))
def test_each_pair_arrives_with_its_newest_stamp(
    events: list[tuple[int, int, int, bool]],
) -> None:
    """Against a plain model: between two sendings, the latest stamp of each pair, once."""
    merger = TransformMerger(CDR)
    model: dict[tuple[str, str], tuple[int, int]] = {}
    for number, (parent, child, stamp_s, flush) in enumerate(events):
        pair = (f"p{parent}", f"c{child}")
        merger.add(message(transform(*pair, stamp_s, number)), now=0)
        if pair not in model or stamp_s >= model[pair][0]:
            model[pair] = (stamp_s, number)
        if flush:
            assert pairs(merger.take(now=0)) == {known: float(x) for known, (_, x) in model.items()}
            model.clear()
    assert len(merger) == len(model)
