"""The benchmark of codecs measures what is there."""

from benchmarks.codecs import made, modes_of, seconds_each
from sern_core.bodies.codecs import LOSSLESS, decode, encode
from sern_core.vocabulary.codec_names import Codec, Compression


def test_made_messages_come_back_and_only_lossless_modes_fit_all() -> None:
    for type_name, bodies in made().values():
        assert set(LOSSLESS[1:]) <= set(modes_of(type_name))
        assert Compression.VOXEL_DRACO not in modes_of(type_name)
        for body in bodies:
            codec, packed = encode(Compression.ZSTD, body)
            assert codec is Codec.ZSTD
            assert decode(codec, packed, max_bytes=len(body)) == body


def test_every_body_is_worked_on() -> None:
    seen: list[bytes] = []
    assert seconds_each(seen.append, [b"a", b"b"], 0.0) >= 0.0
    assert seen == [b"a", b"b"]
