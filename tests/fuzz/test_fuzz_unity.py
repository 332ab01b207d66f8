"""Frames of scenes, in any pieces and with anything in them."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_client.endpoints.unity.framing import MAX_DESTINATION_BYTES, Frame, Frames, frame, parameters_of
from sern_core.vocabulary.errors import WireError

MOST_BYTES = 2_000
NAMES = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)


@given(st.lists(st.tuples(NAMES, st.binary(max_size=300)), max_size=8), st.data())
def test_frames_come_out_as_they_went_in(sent: list[tuple[str, bytes]], data: st.DataObject) -> None:
    stream = b"".join(frame(name, body) for name, body in sent)
    frames, at = Frames(MOST_BYTES), 0
    got: list[Frame] = []
    while at < len(stream):
        size = data.draw(st.integers(1, 200))
        got += frames.feed(stream[at : at + size])
        at += size
    assert got == [Frame(name, body) for name, body in sent] and not frames.nbytes


@given(st.binary(max_size=400), st.integers(1, 400))
def test_anything_is_frames_or_an_error_and_nothing_more_is_held_than_one(stream: bytes, size: int) -> None:
    frames = Frames(MOST_BYTES)
    try:
        for at in range(0, len(stream), size):
            for found in frames.feed(stream[at : at + size]):
                assert len(found.body) <= MOST_BYTES and len(found.destination) <= MAX_DESTINATION_BYTES
            assert frames.nbytes <= 8 + MAX_DESTINATION_BYTES + MOST_BYTES
    except WireError:
        pass  # what had come before it was looked at


@given(st.integers(MOST_BYTES + 1, 2**32 - 1))
def test_a_length_that_nobody_may_send_is_refused_before_its_bytes_come(nbytes: int) -> None:
    for begin in (b"", struct.pack("<I", 1) + b"/"):
        with pytest.raises(WireError, match=str(nbytes)):
            list(Frames(MOST_BYTES).feed(begin + struct.pack("<I", nbytes)))


@given(st.binary(max_size=200))
def test_parameters_are_a_mapping_or_an_error(body: bytes) -> None:
    try:
        said = parameters_of(body)
    except WireError:
        return
    assert isinstance(said, dict)
