"""The golden vectors in `schemas/vectors`: decoded, encoded again, and rejected as they say."""

import json
from pathlib import Path
from typing import Any

import pytest

from sern_core.bodies import codecs
from sern_core.vocabulary.errors import RemoteError
from sern_core.wire import framing
from sern_core.wire.announce import decode_announcement, encode_announcement
from tests.make_vectors import DIRECTORY, FLAGS, decode, encode, files

VALID = sorted(path for path in DIRECTORY.glob("*.json") if path.name != "rejected.json")
REJECTED: list[dict[str, Any]] = json.loads((DIRECTORY / "rejected.json").read_text())


def load(path: Path) -> dict[str, Any]:
    vector: dict[str, Any] = json.loads(path.read_text())
    return vector


@pytest.mark.parametrize("path", VALID, ids=lambda path: path.stem)
def test_golden(path: Path) -> None:
    vector = load(path)
    data = bytes.fromhex(vector["hex"])
    assert vector["name"] == path.stem
    meaning = {key: value for key, value in vector.items() if key not in ("name", "what", "hex")}
    assert decode(vector["layer"], data) == meaning
    if vector.get("attachment"):
        # Compressed bytes may differ from one zlib to the next: the envelope in front of them may not.
        assert decode("control", encode(vector)) == meaning
        data = data[: 2 + int.from_bytes(data[:2])]
        vector["attachment"] = ""
    assert encode(vector) == data


@pytest.mark.parametrize("vector", REJECTED, ids=lambda vector: vector["name"])
def test_rejected(vector: dict[str, Any]) -> None:
    data = bytes.fromhex(vector["hex"]) if "hex" in vector else bytes(vector["zero_bytes"])
    with pytest.raises(RemoteError) as caught:
        decode(vector["layer"], data)
    assert (type(caught.value).__name__, str(caught.value)) == (vector["error"], vector["text"])
    assert "\n" not in str(caught.value)


def test_announcement_means_what_it_says() -> None:
    envelope = load(DIRECTORY / "announce.json")["envelope"]
    assert encode_announcement(decode_announcement(envelope)) == envelope


@pytest.mark.parametrize("name", ["data-lz4", "data-zstd"])
def test_encoded_bodies_decode_to_what_they_say(name: str) -> None:
    (frame,) = load(DIRECTORY / f"{name}.json")["frames"]
    body = bytes.fromhex(frame["body"])
    assert codecs.decode(frame["codec"], body, max_bytes=120) == b"robot " * 20


def test_every_kind_frame_and_flag_has_a_vector() -> None:
    vectors = [load(path) for path in VALID]
    headers = {vector["header"]["kind"] for vector in vectors if "header" in vector}
    frames = [frame for vector in vectors for frame in vector.get("frames", ())]
    assert headers == {kind.name for kind in framing.Kind}
    assert {frame["type"] for frame in frames} == {"DATA", "ACK", "WATERMARK", "PING"}
    assert {flag for frame in frames for flag in frame.get("flags", ())} == set(FLAGS)


def test_files_are_what_the_script_writes() -> None:
    wanted = files()
    assert sorted(path.name for path in DIRECTORY.iterdir()) == sorted(wanted)
    for name, text in wanted.items():
        on_disk = json.loads((DIRECTORY / name).read_text())
        expected = json.loads(text)
        if isinstance(on_disk, dict) and on_disk.get("attachment"):
            on_disk.pop("hex"), expected.pop("hex")
        if name != "rejected.json":
            assert on_disk == expected, f"{name} is out of date: python -m tests.make_vectors"
        else:
            assert [v["name"] for v in on_disk] == [v["name"] for v in expected]
