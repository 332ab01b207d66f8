"""Occupancy patches: rectangles by value and by property; what is shown is always a grid that once was, and after
losses, reordering between the two streams and late joining it is the last one."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from sern_core.summaries.grids import read_grid, read_update, write_grid, write_update
from sern_core.summaries.patches import (
    MAX_RECTANGLES,
    GridRebuilder,
    PatchMaker,
    PatchParams,
    Rectangle,
    changed_rectangles,
)
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from tests.exploring import cases
from tests.sern_core.summaries import scenes

CDR = Encoding.CDR


def grid_body(
    cells: NDArray[Any], stamp_s: int = 5, encoding: Encoding = CDR, *, frame_id: str = "map", x_m: float = -1.5
) -> bytes:
    pose = ros_types.new("geometry_msgs/msg/Pose", encoding)
    pose.position.x, pose.orientation.w = x_m, 1.0
    info = ros_types.new(
        "nav_msgs/msg/MapMetaData",
        encoding,
        map_load_time=ros_types.time_of(7_000_000_001, encoding),
        resolution=0.25,
        width=cells.shape[1],
        height=cells.shape[0],
        origin=pose,
    )
    message = ros_types.new(
        scenes.GRID,
        encoding,
        header=ros_types.header(stamp_s * 10**9 + 250, frame_id, encoding, 3),
        info=info,
        data=np.ascontiguousarray(cells, np.int8).reshape(-1),
    )
    return scenes.write(message, scenes.GRID, encoding)


def cells_of(body: bytes, encoding: Encoding = CDR) -> NDArray[np.int8]:
    return read_grid(body, encoding).cells


class Sent(NamedTuple):
    """A message of one of the two streams."""

    whole: bool
    seq: int
    stamp_ns: int
    body: bytes


class Sender:
    """A PatchMaker behind two streams; all messages of one change have one stamp."""

    def __init__(self, params: PatchParams | None = None, encoding: Encoding = CDR) -> None:
        self.maker = PatchMaker(params or PatchParams(), encoding)
        self.seqs = {True: 0, False: 0}
        self.stamp_ns = 0

    def send(self, body: bytes, *, whole: bool = False) -> list[Sent]:
        self.stamp_ns += 1
        change = self.maker.change(body, whole=whole, now=self.stamp_ns * 0.1)
        bodies = [(True, change.whole)] if change.whole is not None else []
        return [self._next(kind, body) for kind, body in [*bodies, *((False, update) for update in change.updates)]]

    def _next(self, whole: bool, body: bytes) -> Sent:
        self.seqs[whole] += 1
        return Sent(whole, self.seqs[whole], self.stamp_ns, body)


def deliver(rebuilder: GridRebuilder, messages: Iterable[Sent]) -> list[bytes]:
    """What is shown on the way."""
    shown = []
    for sent in messages:
        if sent.whole:
            body = rebuilder.keyframe(sent.body, stamp_ns=sent.stamp_ns)
        else:
            body = rebuilder.update(sent.body, seq=sent.seq, stamp_ns=sent.stamp_ns)
        if body is not None:
            shown.append(body)
    return shown


# --- the layouts -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (3, 4)])
@pytest.mark.parametrize("frame_id", ["", "map", "robot/odom"])
def test_grids_and_updates_are_laid_out_as_rosbags_says(
    encoding: Encoding, shape: tuple[int, int], frame_id: str
) -> None:
    cells = np.arange(shape[0] * shape[1], dtype=np.int8).reshape(shape) - 1
    body = grid_body(cells, encoding=encoding, frame_id=frame_id)
    grid = read_grid(body, encoding)
    assert np.array_equal(grid.cells, cells) and grid.header.frame_id == frame_id
    assert (grid.frame.resolution_m, grid.frame.position, grid.load_time) == (0.25, (-1.5, 0, 0), (7, 1))
    assert write_grid(grid, encoding) == body
    message = ros_types.new(
        scenes.UPDATE,
        encoding,
        header=scenes.read(body, scenes.GRID, encoding).header,
        x=-3,
        y=7,
        width=shape[1],
        height=shape[0],
        data=cells.reshape(-1),
    )
    update_body = scenes.write(message, scenes.UPDATE, encoding)
    update = read_update(update_body, encoding)
    assert (update.x, update.y) == (-3, 7) and np.array_equal(update.cells, cells)
    assert write_update(update, encoding) == update_body


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_every_shortened_body_is_refused(encoding: Encoding) -> None:
    body = grid_body(np.zeros((2, 3)), encoding=encoding)
    for size in range(len(body)):
        with pytest.raises(BodyError):
            read_grid(body[:size], encoding)
    for changed in (body + bytes(8), grid_body(np.zeros((2, 3)), encoding=encoding)[:-1]):
        with pytest.raises(BodyError):
            PatchMaker(PatchParams(), encoding).change(changed, now=0)


# --- rectangles ------------------------------------------------------------------------------------------------------


def test_far_apart_changes_are_rectangles_of_their_own() -> None:
    before = np.zeros((200, 300), np.int8)
    after = before.copy()
    after[10:12, 20:25] = 100
    after[150:160, 250] = -1
    assert sorted(changed_rectangles(before, after)) == [Rectangle(20, 10, 5, 2), Rectangle(250, 150, 1, 10)]
    after[13, 26] = 1  # near enough: another message would cost more than the cells between
    assert len(changed_rectangles(before, after)) == 2
    assert changed_rectangles(before, before) == []


def test_there_are_not_too_many_rectangles() -> None:
    before = np.zeros((400, 400), np.int8)
    after = before.copy()
    after[range(0, 400, 10), range(0, 400, 10)] = 100
    rectangles = changed_rectangles(before, after)
    assert len(rectangles) == MAX_RECTANGLES
    assert all(at_least_one_cell(before, after, at) for at in rectangles)


def at_least_one_cell(before: NDArray[np.int8], after: NDArray[np.int8], at: Rectangle) -> bool:
    part = (slice(at.y, at.y + at.height), slice(at.x, at.x + at.width))
    return bool((before[part] != after[part]).any())


@given(
    arrays.arrays(np.int8, (30, 40), elements=st.integers(0, 1), fill=st.just(0)),
    arrays.arrays(np.int8, (30, 40), elements=st.integers(0, 1), fill=st.just(0)),
)
def test_rectangles_hold_every_changed_cell(before: NDArray[np.int8], after: NDArray[np.int8]) -> None:
    result = before.copy()
    for at in changed_rectangles(before, after):
        part = (slice(at.y, at.y + at.height), slice(at.x, at.x + at.width))
        result[part] = after[part]
    assert np.array_equal(result, after)


# --- two streams -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_a_change_arrives_as_a_whole_grid_of_its_stamp(encoding: Encoding) -> None:
    cells = np.full((100, 120), -1, np.int8)
    sender, rebuilder = Sender(encoding=encoding), GridRebuilder(encoding)
    first = grid_body(cells, 5, encoding)
    assert deliver(rebuilder, sender.send(first)) == [first]
    cells[50, 60:70] = 100
    cells[5, 5] = 0
    second = grid_body(cells, 6, encoding)
    messages = sender.send(second)
    assert not any(sent.whole for sent in messages)
    updates = [scenes.read(sent.body, scenes.UPDATE, encoding) for sent in messages]
    assert [(u.x, u.y, u.width, u.height) for u in updates] == [(5, 5, 1, 1), (60, 50, 10, 1), (0, 0, 0, 0)]
    assert all(u.header.stamp.sec == 6 and u.header.frame_id == "map" for u in updates)
    assert sum(len(sent.body) for sent in messages) < len(second) / 40
    assert deliver(rebuilder, messages) == [second]
    assert deliver(rebuilder, sender.send(grid_body(cells, 7, encoding))) == [grid_body(cells, 7, encoding)]


@pytest.mark.parametrize(
    "other",
    [
        {"x_m": 2.0},
        {"frame_id": "odom"},
        {"cells": np.zeros((3, 5))},
        {"cells": np.full((4, 5), 100)},
    ],
)
def test_what_an_update_cannot_say_is_sent_whole(other: dict[str, Any]) -> None:
    sender = Sender()
    sender.send(grid_body(np.zeros((4, 5))))
    arguments = {"cells": np.zeros((4, 5)), **other}
    messages = sender.send(grid_body(**arguments))
    assert [sent.whole for sent in messages] == [True, False]
    mark = read_update(messages[1].body, CDR)
    assert mark.cells.shape == (0, 5)


def test_keyframes_come_after_so_many_updates_or_so_long() -> None:
    cells = np.zeros((50, 50), np.int8)
    sender = Sender(PatchParams(keyframe_updates=9, keyframe_s=0.65))
    kinds = []
    for number in range(8):
        cells[0, 0] = number
        kinds.append(sender.send(grid_body(cells))[0].whole)
    # A keyframe's mark and four changes of a rectangle and its end are nine updates.
    assert kinds == [True, False, False, False, False, True, False, False]
    # What was changed before is a reason after 0.65 s; after that, grids without a change, only their number.
    kinds += [sender.send(grid_body(cells))[0].whole for _ in range(20)]
    assert [index for index, whole in enumerate(kinds) if whole] == [0, 5, 12, 21]


def test_after_a_loss_the_next_grid_goes_whole() -> None:
    sender = Sender()
    body = grid_body(np.zeros((50, 50)))
    sender.send(body)
    assert not sender.send(body)[0].whole
    sender.maker.forget()
    assert sender.send(body)[0].whole
    assert sender.send(body, whole=True)[0].whole


def test_a_late_joiner_needs_the_last_keyframe_and_what_came_after() -> None:
    cells = np.zeros((50, 50), np.int8)
    sender = Sender()
    sent: list[Sent] = []
    for number in range(30):
        cells[number, number] = 100
        sent += sender.send(grid_body(cells, number))
    whole = [message for message in sent if message.whole][-1:]
    updates = [message for message in sent if not message.whole][-sender.maker.params.keyframe_updates :]
    for order in (whole + updates, updates + whole):  # replays of two streams come in any order
        assert np.array_equal(cells_of(deliver(GridRebuilder(CDR), order)[-1]), cells)


def test_a_keyframe_that_comes_late_lets_what_waits_for_it_through() -> None:
    cells = np.zeros((9, 9), np.int8)
    sender, rebuilder = Sender(), GridRebuilder(CDR)
    deliver(rebuilder, sender.send(grid_body(cells, 1)))
    cells[0, 0] = 1
    whole, mark = sender.send(grid_body(cells, 2), whole=True)
    cells[8, 8] = 2
    later = sender.send(grid_body(cells, 3))
    assert deliver(rebuilder, [mark, *later]) == []
    assert deliver(rebuilder, [whole]) == [grid_body(cells, 3)]
    assert deliver(rebuilder, [whole]) == [] and rebuilder.gaps == 0


def test_a_rectangle_outside_the_grid_is_refused_and_the_next_keyframe_mends_it() -> None:
    sender, rebuilder = Sender(), GridRebuilder(CDR)
    small, large = np.zeros((4, 4), np.int8), np.zeros((40, 40), np.int8)
    deliver(rebuilder, sender.send(grid_body(small)))
    other = Sender()
    other.send(grid_body(large))
    large[30, 30] = 1
    rectangle, end = other.send(grid_body(large))
    with pytest.raises(BodyError, match="do not lie in the grid"):
        deliver(rebuilder, [rectangle])
    assert deliver(rebuilder, [end]) == [] and rebuilder.gaps == 1
    assert deliver(rebuilder, [Sent(True, 9, 99, grid_body(small))]) == [grid_body(small)]


def test_what_waits_is_bounded() -> None:
    sender, rebuilder = Sender(PatchParams(keyframe_updates=10**6)), GridRebuilder(CDR)
    cells = np.zeros((50, 50), np.int8)
    sender.send(grid_body(cells))
    for number in range(1500):
        cells[0, 0] = number % 100
        deliver(rebuilder, sender.send(grid_body(cells)))
    assert len(rebuilder._waiting) == 1024


@settings(max_examples=cases(80))
@given(st.data(), st.sampled_from(scenes.ENCODINGS))
def test_with_losses_only_true_grids_are_shown_and_the_next_keyframe_converges(
    data: st.DataObject, encoding: Encoding
) -> None:
    cells = np.zeros((24, 32), np.int8)
    sender = Sender(PatchParams(keyframe_updates=data.draw(st.sampled_from([3, 8, 64]))), encoding)
    true: dict[bytes, bool] = {}
    wholes: list[Sent] = []
    updates: list[Sent] = []
    last = b""
    for number in range(data.draw(st.integers(1, 12))):
        for _ in range(data.draw(st.integers(0, 3))):
            y, x = data.draw(st.integers(0, 23)), data.draw(st.integers(0, 31))
            cells[y : y + 2, x : x + 3] = data.draw(st.integers(-1, 100))
        last = grid_body(cells, number, encoding)
        true[last] = True
        for sent in sender.send(last, whole=data.draw(st.integers(0, 9)) == 0):
            if data.draw(st.integers(0, 3)):  # else it is lost
                (wholes if sent.whole else updates).append(sent)
    rebuilder = GridRebuilder(encoding)
    arrived: list[Sent] = []
    while wholes or updates:  # each stream in its order, one against the other in any
        from_wholes = bool(wholes) and (not updates or data.draw(st.booleans()))
        arrived.append((wholes if from_wholes else updates).pop(0))
    shown = deliver(rebuilder, arrived)
    assert all(body in true for body in shown)
    stamps = [read_grid(body, encoding).header.sec for body in shown]
    assert stamps == sorted(stamps)
    sender.maker.forget()
    cells[3, 3] = 55
    final = [grid_body(cells, 100, encoding), grid_body(cells * 0, 101, encoding)]
    assert deliver(rebuilder, sender.send(final[0])) == final[:1]
    assert deliver(rebuilder, sender.send(final[1])) == final[1:]


@given(st.data())
def test_without_losses_the_last_grid_is_shown_whatever_the_order_of_the_streams(data: st.DataObject) -> None:
    cells = np.zeros((20, 20), np.int8)
    sender = Sender(PatchParams(keyframe_updates=8))
    wholes: list[Sent] = []
    updates: list[Sent] = []
    for number in range(data.draw(st.integers(1, 15))):
        cells[data.draw(st.integers(0, 19)), data.draw(st.integers(0, 19))] += 1
        for sent in sender.send(grid_body(cells, number)):
            (wholes if sent.whole else updates).append(sent)
    rebuilder = GridRebuilder(CDR)
    shown: list[bytes] = []
    while wholes or updates:
        from_wholes = bool(wholes) and (not updates or data.draw(st.booleans()))
        shown += deliver(rebuilder, [(wholes if from_wholes else updates).pop(0)])
    assert np.array_equal(cells_of(shown[-1]), cells) and rebuilder.gaps == 0


@given(st.data(), st.sampled_from(scenes.ENCODINGS))
def test_a_changed_update_is_applied_or_refused(data: st.DataObject, encoding: Encoding) -> None:
    sender, rebuilder = Sender(encoding=encoding), GridRebuilder(encoding)
    cells = np.zeros((8, 8), np.int8)
    deliver(rebuilder, sender.send(grid_body(cells, encoding=encoding)))
    cells[2:4, 3:5] = 7
    messages = sender.send(grid_body(cells, encoding=encoding))
    broken = bytearray(messages[0].body)
    for _ in range(data.draw(st.integers(1, 3))):
        broken[data.draw(st.integers(0, len(broken) - 1))] = data.draw(st.integers(0, 255))
    try:
        deliver(rebuilder, [messages[0]._replace(body=bytes(broken)), *messages[1:]])
    except BodyError:
        pass
    else:
        assert rebuilder.gaps == 0
    whole = grid_body(cells, 9, encoding)
    assert deliver(rebuilder, [Sent(True, 2, 50, whole)]) == [whole]
