"""Puts a recording and what was fetched, or the files of a robot's spool, into one recording: by stamp, nothing twice.

A message is there twice if topic, stamp and body are the same: one that a killed site fetched again, or that came live
after all. Bodies are read when they are written, so that memory holds the places of messages only.
"""

import hashlib
import heapq
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Final, NamedTuple

from rosbags.interfaces import Connection, ConnectionExtRosbag1, ConnectionExtRosbag2, QosDurability
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import ReaderError as ReaderError1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as ReaderError2

from sern_client.endpoints.bag_files import BagFile, McapFile, RecordFile, active_path
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.spool.files import UNREADABLE, KeptStream, message_at, messages_of

SUFFIXES: Final = {".bag": Encoding.ROS1, ".mcap": Encoding.CDR}
WORDS: Final = {Encoding.ROS1: "ROS 1", Encoding.CDR: "ROS 2"}


class Found(NamedTuple):
    """A message of one of the inputs."""

    stamp_ns: int
    info: TopicInfo
    body: bytes


@dataclass(frozen=True, slots=True)
class Selection:
    """What goes into the result. `topic` None: every one."""

    topic: TopicName | None = None
    from_ns: int = -(2**63)
    to_ns: int = 2**63 - 1

    def takes(self, name: str, stamp_ns: int) -> bool:
        return self.from_ns <= stamp_ns <= self.to_ns and self.topic in (None, name)


@dataclass(slots=True)
class Merged:
    """What came of it."""

    messages: int = 0
    twice: int = 0
    cut_off: list[Path] | None = None
    """Inputs that are not whole; what is whole of them is there."""
    damaged: int = 0
    """Kept messages that are not what was written; they are left out."""


def merge(inputs: Sequence[Path], out: Path, selection: Selection) -> Merged:
    """Write `out`, a `.bag` (ROS 1) or `.mcap` (ROS 2), from recordings, files of a spool, and folders with such files.
    Raises ConfigError: nothing is written then."""
    encoding = SUFFIXES.get(out.suffix)
    if encoding is None:
        raise ConfigError("must end in .bag (ROS 1) or .mcap (ROS 2)", file=str(out))
    if out.exists() or active_path(out).exists():
        raise ConfigError("exists already; move it away or choose another name", file=str(out))
    done = Merged(cut_off=[])
    sources = [source for path in _files(inputs) for source in _sources(path, selection, done)]
    infos = _Infos(encoding, out)
    kind: type[RecordFile] = BagFile if encoding is Encoding.ROS1 else McapFile
    try:
        file = kind(out)
    except OSError as error:
        raise ConfigError(f"cannot be written ({error.strerror})", file=str(out)) from error
    try:
        for found in _once(heapq.merge(*sources, key=itemgetter(0)), done):
            info = infos.of(found.info)
            file.add(info)
            file.write(info, found.stamp_ns, found.body)
            done.messages += 1
        if not done.messages:
            what = "message" if selection.topic is None else f"message of {selection.topic}"
            raise ConfigError(f"would be empty: the inputs hold no {what} of that time", file=str(out))
        lost = file.finish()
    except OSError as error:
        _discard(file)
        raise ConfigError(f"cannot be written ({error.strerror}); make room", file=str(out)) from error
    except BaseException:
        _discard(file)
        raise
    if lost:
        raise ConfigError(f"the disk is full; its last {lost} messages are missing", file=str(out))
    return done


def _discard(file: RecordFile) -> None:
    """Leave nothing of it."""
    file.give_up()
    with suppress(OSError):
        file.finish()
    file.path.unlink(missing_ok=True)
    shutil.rmtree(file.active, ignore_errors=True)
    file.active.unlink(missing_ok=True)


def _files(inputs: Sequence[Path]) -> Iterator[Path]:
    """ConfigError for what is not there."""
    for path in inputs:
        if path.is_dir():
            inside = sorted(each for each in path.iterdir() if each.suffix in SUFFIXES and each.is_file())
            if not inside:
                raise ConfigError("has no .bag and no .mcap files", file=str(path))
            yield from inside
        elif path.is_file():
            yield path
        else:
            raise ConfigError("no such file or folder", file=str(path))


def _once(found: Iterator[Found], done: Merged) -> Iterator[Found]:
    """Every message once; they come by stamp."""
    stamp_ns, seen = None, set[tuple[str, bytes]]()
    for each in found:
        if each.stamp_ns != stamp_ns:
            stamp_ns = each.stamp_ns
            seen.clear()
        key = (each.info.name, hashlib.blake2b(each.body, digest_size=16).digest())
        if key in seen:
            done.twice += 1
        else:
            seen.add(key)
            yield each


class _Infos:
    """Topics as they go into the result: one for each type, whatever each input says beside."""

    def __init__(self, encoding: Encoding, out: Path) -> None:
        self._encoding = encoding
        self._out = out
        self._made: dict[tuple[str, str, str], TopicInfo] = {}

    def of(self, info: TopicInfo) -> TopicInfo:
        """ConfigError for a message of the other ROS, and for a type that nobody can read."""
        if info.encoding is not self._encoding:
            other = next(suffix for suffix, encoding in SUFFIXES.items() if encoding is info.encoding)
            raise ConfigError(
                f"{info.name} is of {WORDS[info.encoding]}, which this kind of file does not hold; name a {other}, or "
                "choose topics with --topic",
                file=str(self._out),
            )
        key = (info.name, info.type_name, info.definition)
        made = self._made.get(key)
        if made is None:
            type_name, definition = ros_types.canonical(info.type_name), info.definition
            if definition:
                computed = ros_types.hash_of(type_name, definition, info.encoding)
            else:
                known = ros_types.describe(type_name, info.encoding)
                if known is None:
                    raise ConfigError(f"{info.name}: no definition of {type_name} is known", file=str(self._out))
                definition, computed = known
            made = replace(info, type_name=type_name, definition=definition, type_hash=computed, reliable=None)
            self._made[key] = made
        return made


# --- inputs -----------------------------------------------------------------------------------------------------------


def _sources(path: Path, selection: Selection, done: Merged) -> list[Iterator[Found]]:
    """The messages of a file, by stamp. ConfigError where it is none."""
    if path.suffix == ".mcap":
        kept = _of_spool(path, selection, done)
        if kept is not None:
            return [kept]
    elif path.suffix != ".bag":
        raise ConfigError("is no recording; .bag and .mcap are", file=str(path))
    return [_of_recording(path, selection)]


class _Place(NamedTuple):
    stamp_ns: int
    offset: int
    stream: KeptStream


def _of_spool(path: Path, selection: Selection, done: Merged) -> Iterator[Found] | None:
    """Those of a file of a spool; None: it is none."""
    places: list[_Place] = []
    streams: dict[tuple[object, ...], KeptStream] = {}
    try:
        with path.open("rb") as file:
            try:
                for found in messages_of(file):
                    stamp_ns = found.message.log_time
                    if not found.whole:
                        done.damaged += 1
                    elif selection.takes(found.stream.info.name, stamp_ns):
                        stream = streams.setdefault(found.stream.key, found.stream)
                        places.append(_Place(stamp_ns, found.offset, stream))
            except KeyError:
                return None  # channels without our metadata
            except UNREADABLE:
                if not places:
                    return None
                assert done.cut_off is not None
                done.cut_off.append(path)
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", file=str(path)) from error
    places.sort(key=itemgetter(0, 1))
    return _bodies(path, places)


def _bodies(path: Path, places: Sequence[_Place]) -> Iterator[Found]:
    try:
        with path.open("rb") as file:
            for stamp_ns, offset, stream in places:
                record = message_at(file, offset)
                if record is None:
                    raise ConfigError("has changed while it was read; try again", file=str(path))
                yield Found(stamp_ns, stream.info, record.data)
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", file=str(path)) from error


def _of_recording(path: Path, selection: Selection) -> Iterator[Found]:
    reader: Reader1 | Reader2 = Reader1(path) if path.suffix == ".bag" else Reader2(path)
    encoding = SUFFIXES[path.suffix]
    infos: dict[int, TopicInfo] = {}
    try:
        with reader:
            for connection, stamp_ns, body in reader.messages():
                if selection.takes(connection.topic, stamp_ns):
                    info = infos.get(connection.id)
                    if info is None:
                        info = infos[connection.id] = _info(connection, encoding)
                    yield Found(stamp_ns, info, bytes(body))
    except (ReaderError1, ReaderError2, *UNREADABLE) as error:
        raise ConfigError(
            f"cannot be read as a recording ({ros_types.one_line(error)}); one that a killed process left is finished "
            "by `sern recover`",
            file=str(path),
        ) from error
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", file=str(path)) from error


def _info(connection: Connection, encoding: Encoding) -> TopicInfo:
    ext = connection.ext
    latched = (isinstance(ext, ConnectionExtRosbag1) and bool(ext.latching)) or (
        isinstance(ext, ConnectionExtRosbag2)
        and any(qos.durability is QosDurability.TRANSIENT_LOCAL for qos in ext.offered_qos_profiles)
    )
    return TopicInfo(
        TopicName(connection.topic), connection.msgtype, encoding, connection.digest, connection.msgdef.data, latched
    )
