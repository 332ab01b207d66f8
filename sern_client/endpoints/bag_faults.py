"""Why a recording cannot be read, in words: readers of damaged files raise almost anything, often without a text."""

import re
from pathlib import Path
from typing import Final

from rosbags.rosbag1 import ReaderError as ReaderError1
from rosbags.rosbag2 import ReaderError as ReaderError2

from sern_runtime.ros_types import one_line

_BAG_MAGIC: Final = b"#ROSBAG V2.0\n"
_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
_SQLITE_MAGIC: Final = b"SQLite format 3\x00"
_INDEX_AT: Final = re.compile(rb"index_pos=(.{8})", re.DOTALL)
_HEAD_BYTES: Final = 4096


def why(path: Path, error: Exception) -> str:
    """One line. What the file itself shows goes first: it says more than the error."""
    try:
        seen = _seen(path)
    except OSError as trouble:
        seen = (trouble.strerror or one_line(trouble)).lower()
    if seen:
        return seen
    if isinstance(error, ReaderError1 | ReaderError2 | OSError) and str(error):
        return one_line(error)
    text = one_line(error)
    return f"its bytes are damaged{'' if text == type(error).__name__ else f': {text}'}"


def _seen(path: Path) -> str:
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix in (".db3", ".mcap"))
        found = next((f"{file.name}: {text}" for file in files if (text := _seen(file))), "")
        return found or ("" if files else "there is no .db3 and no .mcap in it")
    with path.open("rb") as file:
        size = file.seek(0, 2)
        if not size:
            return "it is empty"
        file.seek(0)
        head = file.read(_HEAD_BYTES)
        file.seek(max(0, size - len(_MCAP_MAGIC)))
        tail = file.read()
    if path.suffix == ".bag":
        return _bag(head, size)
    if path.suffix == ".mcap":
        if not head.startswith(_MCAP_MAGIC):
            return "it is not an MCAP file"
        return "" if tail == _MCAP_MAGIC else "its end is missing: it was cut off, or the recording was not finished"
    if path.suffix == ".db3" and not head.startswith(_SQLITE_MAGIC):
        return "it is not an SQLite database"
    return ""


def _bag(head: bytes, size: int) -> str:
    if not head.startswith(_BAG_MAGIC):
        return "it is not a ROS 1 bag of version 2.0"
    found = _INDEX_AT.search(head)
    if found is None:
        return "its header is damaged"
    index_at = int.from_bytes(found[1], "little")
    if not index_at:
        return "it has no index: the recording was not finished"
    if index_at >= size:
        return f"it is cut off: {size} bytes are left, and its index begins at byte {index_at}"
    return ""
