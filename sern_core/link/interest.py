"""Which of the peer's streams are wanted, and by whom: told when it changes, by difference, many streams at a time.

Nothing is said where the answer is what the peer was told before. What the peer has not been told in the session at
all goes with the next datagram. A change of that waits: one that turns a stream on until `PAUSE_MIN_S` after what was
told last, any other for a pause that doubles up to `PAUSE_MAX_S` while changes keep coming, and each until the peer has
acknowledged what was told last. What flaps in between is never told.

A peer that does not understand several channels in one message, or differences, is told each stream by itself.
"""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from sern_core.stream.in_stream import InStream
from sern_core.wire import framing
from sern_core.wire.announce import MAX_STRINGS, encode_want

PAUSE_MIN_S: Final = 0.1
PAUSE_MAX_S: Final = 2.0
MAX_UNACKED_ANSWERS: Final = 256
"""Control messages that may wait for the peer's acknowledgement before first answers wait as well."""
NEVER: Final = float("inf")

Send = Callable[[framing.Envelope], int]
"""Queues a control message; returns its number."""


class _Answer(NamedTuple):
    on: bool
    required: tuple[str, ...]


class _Change(NamedTuple):
    stream: InStream
    answer: _Answer
    was_paused: bool
    """`InStream.paused` before anything that the peer has not been told."""


class _Group(NamedTuple):
    """What is said of several channels alike. `required` None: by difference."""

    on: bool
    required: tuple[str, ...] | None
    add: tuple[str, ...]
    drop: tuple[str, ...]


class Interest:
    """One end's answers to the streams that the peer has announced in the session; all by channel."""

    def __init__(self) -> None:
        self.batches = False
        """Whether the peer understands several channels in one message, and differences."""
        self._told: dict[int, _Answer] = {}
        self._changes: dict[int, _Change] = {}
        self._due_s = NEVER
        self._held = False  # until the peer has acknowledged what was told last
        self._last_s = -NEVER
        self._last_seq = 0
        self._pause_s = PAUSE_MIN_S

    def __bool__(self) -> bool:
        """Whether anything is to be told."""
        return bool(self._changes)

    @property
    def deadline_s(self) -> float:
        """When `tell` has something to say by time alone."""
        return NEVER if self._held or not self._changes else self._due_s

    def begin(self) -> None:
        """A session has begun: the peer has been told nothing."""
        self.batches = False
        self._told.clear()
        self._changes.clear()
        self._due_s = NEVER
        self._held = False
        self._last_s = -NEVER
        self._last_seq = 0
        self._pause_s = PAUSE_MIN_S

    def forget(self, channel_id: int) -> None:
        """The channel is closed, or was refused."""
        self._told.pop(channel_id, None)
        self._changes.pop(channel_id, None)

    def answer(self, channel_id: int, stream: InStream, wanted: bool, required: tuple[str, ...], *, now: float) -> bool:
        """The answer to a stream, as it is now. Returns whether that is news."""
        answer = _Answer(wanted, required)
        told = self._told.get(channel_id)
        if told is None:
            change = self._changes.get(channel_id)
            was_paused = stream.paused if change is None else change.was_paused
            stream.wanted = wanted
            stream.paused = was_paused or not wanted
            stream.pause_seq = 0
            self._changes[channel_id] = _Change(stream, answer, was_paused)
        elif told.on == wanted and (told.required == required or set(told.required) == set(required)):
            self._changes.pop(channel_id, None)
            return False
        else:
            self._changes[channel_id] = _Change(stream, answer, stream.paused)
        self._due_s = min(self._due_s, self._due_of(channel_id, now))
        self._held = False  # that is for `tell` to find out
        return True

    def _due_of(self, channel_id: int, now: float) -> float:
        """When the change of a channel is to be told."""
        told = self._told.get(channel_id)
        if told is None:
            return now
        turns_on = self._changes[channel_id].answer.on and not told.on
        return self._last_s + (PAUSE_MIN_S if turns_on else self._pause_s)

    def tell(self, send: Send, *, acked_seq: int, unacked: int, now: float) -> None:
        """Say what is due. `acked_seq`: the number of the last control message that the peer has acknowledged,
        `unacked` how many it has not."""
        if now < self._due_s:
            return
        changes = self._changes
        self._held = unacked > MAX_UNACKED_ANSWERS or self._last_seq > acked_seq
        if self._held:
            # What the peer has not been told at all does not wait for it, unless it never reads.
            changes = {channel_id: change for channel_id, change in changes.items() if channel_id not in self._told}
            if not changes or unacked > MAX_UNACKED_ANSWERS:
                return
        elif any(channel_id in self._told for channel_id in changes):
            quiet = now - self._last_s >= 2.0 * self._pause_s
            self._pause_s = PAUSE_MIN_S if quiet else min(PAUSE_MAX_S, 2.0 * self._pause_s)
        self._last_s = now
        groups: dict[_Group, list[int]] = {}
        for channel_id, change in changes.items():
            if self.batches:
                group = _difference(self._told.get(channel_id), change.answer)
            else:
                group = _Group(change.answer.on, change.answer.required, (), ())
            groups.setdefault(group, []).append(channel_id)
        for group, channel_ids in groups.items():
            self._say(group, sorted(channel_ids), changes, send)
        self._changes = {
            channel_id: change for channel_id, change in self._changes.items() if channel_id not in changes
        }
        self._due_s = min((self._due_of(channel_id, now) for channel_id in self._changes), default=NEVER)

    def _say(self, group: _Group, channel_ids: Sequence[int], changes: dict[int, _Change], send: Send) -> None:
        for some in _chunks(channel_ids) if self.batches else [[channel_id] for channel_id in channel_ids]:
            seq = 0
            for envelope in _messages(group, some):
                seq = send(envelope)
            self._last_seq = seq
            for channel_id in some:
                stream, answer, _was_paused = changes[channel_id]
                told = self._told.get(channel_id)
                self._told[channel_id] = answer
                if told is None or told.on != answer.on:
                    stream.wanted = answer.on
                    stream.paused = stream.paused or not answer.on
                    stream.pause_seq = 0 if answer.on else seq


def _difference(told: _Answer | None, answer: _Answer) -> _Group:
    """The shorter of the whole list and what is new in it."""
    if told is None:
        return _Group(answer.on, answer.required, (), ())
    before, after = set(told.required), set(answer.required)
    add = tuple(name for name in answer.required if name not in before)
    drop = tuple(name for name in told.required if name not in after)
    if _names_bytes(answer.required) <= _names_bytes(add) + _names_bytes(drop):
        return _Group(answer.on, answer.required, (), ())
    return _Group(answer.on, None, add, drop)


def _names_bytes(names: Sequence[str]) -> int:
    return sum(len(name) + 1 for name in names)


def _chunks(channel_ids: Sequence[int]) -> list[list[int]]:
    """Rising channels, in so many parts that the runs of each fit into one message."""
    parts: list[list[int]] = [[]]
    runs = 0
    for channel_id in channel_ids:
        part = parts[-1]
        if part and channel_id != part[-1] + 1:
            runs += 1
            if 2 * (runs + 1) > MAX_STRINGS:
                parts.append([])
                part, runs = parts[-1], 0
        part.append(channel_id)
    return parts


def _messages(group: _Group, channel_ids: Sequence[int]) -> list[framing.Envelope]:
    """What says this of these channels; of a long list of names, several messages."""
    if group.required is None:
        signed = [*((name, True) for name in group.add), *((name, False) for name in group.drop)]
        rows = [signed[i : i + MAX_STRINGS] for i in range(0, max(1, len(signed)), MAX_STRINGS)]
        return [
            encode_want(
                channel_ids,
                group.on,
                add=[name for name, more in row if more],
                drop=[name for name, more in row if not more],
            )
            for row in rows
        ]
    required = group.required
    messages: list[framing.Envelope] = []
    for start in range(0, max(1, len(required)), MAX_STRINGS):
        more = start + MAX_STRINGS < len(required)
        part = required[start : start + MAX_STRINGS]
        messages.append(encode_want(channel_ids[:1] if more else channel_ids, group.on, required=part, more=more))
    return messages
