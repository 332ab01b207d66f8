"""Sealing: nothing opens twice, elsewhere, or changed; and the window is a set of what has arrived."""

import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sern_core.vocabulary.errors import RefusedError, UsageError, WireError
from sern_core.wire.framing import decode_envelope, encode_envelope
from sern_runtime import seal
from sern_runtime.seal import (
    CLEAR_BYTES,
    REKEY_SHARE,
    REPLAY_WINDOW,
    ROOM_BYTES,
    SEAL_BYTES,
    SEAL_LIMITS,
    UDP_PAYLOAD_BYTES,
    Cipher,
    Opener,
    RekeyError,
    Sealer,
    SessionParameters,
    Side,
    choose_cipher,
    make_seals,
    offered_ciphers,
)
from tests.exploring import cases

SECRET = bytes(range(32))
AES, CHACHA = Cipher.AES_256_GCM, Cipher.CHACHA20_POLY1305
both_ciphers = pytest.mark.parametrize("cipher", list(Cipher))


def parameters(cipher: Cipher = AES, *, session_id: int = 0x01020304, secret: bytes = SECRET) -> SessionParameters:
    return SessionParameters(session_id, secret, cipher, 5555)


@both_ciphers
def test_both_directions_open_at_the_other_side(cipher: Cipher) -> None:
    client_sealer, client_opener = make_seals(parameters(cipher), Side.CLIENT)
    relay_sealer, relay_opener = make_seals(parameters(cipher), Side.RELAY)
    for data in (b"", b"x", b"y" * ROOM_BYTES):
        up = client_sealer.seal(data)
        assert len(up) == len(data) + SEAL_BYTES
        assert relay_opener.open(up) == data
        assert client_opener.open(memoryview(bytearray(relay_sealer.seal(data)))) == data
    assert client_sealer.counter == relay_opener.highest == 3
    assert not any(relay_opener.refused.values())


def test_the_layout_is_the_documented_one() -> None:
    datagram = Sealer(parameters(), Side.CLIENT).seal(b"hello")
    assert datagram[:CLEAR_BYTES] == struct.pack("!IQ", 0x01020304, 1)
    assert len(datagram) == 12 + 5 + 16
    assert len(Sealer(parameters(), Side.CLIENT).seal(bytes(ROOM_BYTES))) == UDP_PAYLOAD_BYTES == 1200


@pytest.mark.parametrize(
    ("cipher", "sealed"),
    [
        (AES, "010203040000000000000001d1144a4a6c1ae22837d202308dab72401d2db1fd10"),
        (CHACHA, "0102030400000000000000017fd058edabde716184a89c32e242d2f672e5f09641"),
    ],
)
def test_golden_datagrams(cipher: Cipher, sealed: str) -> None:
    """Computed from the description alone, with HMAC from the standard library and the AEAD."""
    assert Sealer(parameters(cipher), Side.CLIENT).seal(b"hello").hex() == sealed


@both_ciphers
@pytest.mark.parametrize("position", [0, 3, 4, 11, 12, 16, 17, 32], ids=lambda position: f"byte{position}")
def test_a_changed_byte_anywhere_is_refused(cipher: Cipher, position: int) -> None:
    datagram = bytearray(Sealer(parameters(cipher), Side.CLIENT).seal(b"hello"))
    assert len(datagram) == 33
    datagram[position] ^= 0x10
    opener = Opener(parameters(cipher), Side.CLIENT)
    assert opener.open(bytes(datagram)) is None
    reason = "foreign" if position < 4 else "bad_tag"
    assert {name: count for name, count in opener.refused.items() if count} == {reason: 1}
    datagram[position] ^= 0x10
    assert opener.open(bytes(datagram)) == b"hello"  # a forgery moved nothing


def test_a_forged_counter_does_not_move_the_window() -> None:
    sealer, opener = Sealer(parameters(), Side.CLIENT), Opener(parameters(), Side.CLIENT)
    first = sealer.seal(b"1")
    for counter in (2, REPLAY_WINDOW, 2**32, 2**64 - 1):
        assert opener.open(struct.pack("!IQ", 0x01020304, counter) + first[CLEAR_BYTES:]) is None
    assert opener.highest == 0
    assert opener.open(first) == b"1"


@pytest.mark.parametrize("length", [0, 1, CLEAR_BYTES, SEAL_BYTES - 1])
def test_what_is_too_short_is_counted_and_nothing_else(length: int) -> None:
    opener = Opener(parameters(), Side.CLIENT)
    assert opener.open(Sealer(parameters(), Side.CLIENT).seal(b"")[:length]) is None
    assert opener.refused == {"short": 1, "foreign": 0, "old": 0, "replayed": 0, "bad_tag": 0}


@pytest.mark.parametrize(
    "other",
    [
        (parameters(), Side.RELAY),
        (parameters(CHACHA), Side.CLIENT),
        (parameters(secret=bytes(32)), Side.CLIENT),
    ],
    ids=["wrong direction", "wrong cipher", "another secret"],
)
def test_other_keys_do_not_open(other: tuple[SessionParameters, Side]) -> None:
    opener = Opener(*other)
    assert opener.open(Sealer(parameters(), Side.CLIENT).seal(b"hello")) is None
    assert opener.bad_tags == 1


def test_keys_depend_on_the_session_id() -> None:
    """The same secret under another id: not even when the id in front is written over."""
    datagram = Sealer(parameters(), Side.CLIENT).seal(b"hello")
    opener = Opener(parameters(session_id=9), Side.CLIENT)
    assert opener.open(datagram) is None
    assert opener.open(struct.pack("!I", 9) + datagram[4:]) is None
    assert (opener.foreign, opener.bad_tags) == (1, 1)


def test_a_datagram_opens_once() -> None:
    sealer, opener = Sealer(parameters(), Side.CLIENT), Opener(parameters(), Side.CLIENT)
    datagrams = [sealer.seal(b"%d" % number) for number in range(1, REPLAY_WINDOW + 2)]
    newest = datagrams[-1]
    assert opener.open(newest) is not None
    assert opener.open(newest) is None
    assert opener.open(datagrams[1]) == b"2"  # the last number inside the window
    assert opener.open(datagrams[1]) is None
    assert opener.open(datagrams[0]) is None  # one too old
    assert (opener.replayed, opener.old) == (2, 1)


def test_counter_zero_is_no_counter() -> None:
    opener = Opener(parameters(), Side.CLIENT)
    assert opener.open(struct.pack("!IQ", 0x01020304, 0) + bytes(20)) is None
    assert opener.replayed == 1


@given(
    arrivals=st.lists(
        st.one_of(
            st.integers(1, 40),
            st.integers(1, 4 * REPLAY_WINDOW),
            st.sampled_from([REPLAY_WINDOW - 1, REPLAY_WINDOW, REPLAY_WINDOW + 1, 2**63, 2**64 - 1]),
        ),
        max_size=60,
    )
)
@example(arrivals=[1, REPLAY_WINDOW, 1, REPLAY_WINDOW + 1, 1, 2])
@example(arrivals=[5, 5 + REPLAY_WINDOW, 6, 5])
@settings(max_examples=cases(200))
def test_the_window_is_a_set_of_what_arrived(arrivals: list[int]) -> None:
    """Against the model: a number opens when it is above the newest less the window, and was not seen."""
    opener = Opener(parameters(), Side.CLIENT)
    seen: set[int] = set()
    for number in arrivals:
        sealer = Sealer(parameters(), Side.CLIENT, limit=SEAL_LIMITS[AES])
        sealer._limit = 2**64  # the model is of the window; limits have their own tests
        sealer.counter = number - 1
        newest = max(seen, default=0)
        expected = number > newest - REPLAY_WINDOW and number not in seen
        assert (opener.open(sealer.seal(b"d")) is not None) == expected
        if expected:
            seen.add(number)
        assert opener.highest == max(seen, default=0)
        assert opener._mask.bit_length() <= REPLAY_WINDOW
    assert opener.bad_tags == 0


def test_a_sealer_asks_for_a_rekey_long_before_it_refuses() -> None:
    sealer = Sealer(parameters(), Side.CLIENT, limit=100)
    due = []
    for _ in range(100):
        assert not sealer.exhausted
        sealer.seal(b"")
        due.append(sealer.rekey_due)
    assert due == [False] * 74 + [True] * 26
    for _ in range(2):
        with pytest.raises(RekeyError, match=r"UDP session 0x01020304 has sealed 100 datagrams; rekey"):
            sealer.seal(b"")
    assert sealer.counter == 100


@both_ciphers
def test_no_limit_lets_the_counter_wrap(cipher: Cipher) -> None:
    sealer = Sealer(parameters(cipher), Side.CLIENT, limit=2**70)
    sealer.counter = SEAL_LIMITS[cipher]
    with pytest.raises(RekeyError):
        sealer.seal(b"")
    assert SEAL_LIMITS[cipher] < 2**63


def test_a_key_that_was_attacked_enough_is_not_believed_any_more() -> None:
    sealer = Sealer(parameters(), Side.CLIENT)
    opener = Opener(parameters(), Side.CLIENT, forgery_limit=4)
    good = sealer.seal(b"good")
    for number in range(4):
        assert opener.rekey_due == (number >= 3)
        assert opener.open(good[:-1] + bytes([good[-1] ^ 1])) is None
    assert opener.open(good) is None
    assert opener.bad_tags == 4


def test_more_than_fits_is_the_callers_mistake() -> None:
    sealer = Sealer(parameters(), Side.CLIENT)
    with pytest.raises(UsageError, match="1173 bytes do not fit"):
        sealer.seal(bytes(ROOM_BYTES + 1))
    assert sealer.counter == 0


@pytest.mark.parametrize(
    ("offered", "own", "chosen"),
    [
        ([AES, CHACHA], [AES, CHACHA], AES),
        ([CHACHA, AES], [AES, CHACHA], CHACHA),  # one side computes AES slowly
        ([AES, CHACHA], [CHACHA, AES], CHACHA),
        ([AES], [CHACHA, AES], AES),
        (["aegis-256", AES, CHACHA], [AES, CHACHA], AES),  # unknown names are passed over
        (["aegis-256", CHACHA], [AES, CHACHA], CHACHA),
    ],
)
def test_the_relay_picks(offered: list[str], own: list[Cipher], chosen: Cipher) -> None:
    assert choose_cipher([str(name) for name in offered], own) is chosen


@pytest.mark.parametrize("offered", [[], ["aegis-256"]])
def test_no_cipher_in_common_is_refused_by_name(offered: list[str]) -> None:
    with pytest.raises(RefusedError) as refused:
        choose_cipher(offered)
    assert refused.value.code == "cipher"


@pytest.fixture
def cpuinfo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    path = tmp_path / "cpuinfo"
    monkeypatch.setattr(seal, "_CPUINFO", path)
    seal.has_aes_instructions.cache_clear()
    yield path
    seal.has_aes_instructions.cache_clear()


@pytest.mark.parametrize(
    ("text", "first"),
    [
        ("processor\t: 0\nflags\t\t: fpu sse2 aes avx\n", AES),
        ("processor\t: 0\nFeatures\t: fp asimd aes pmull\n", AES),
        ("processor\t: 0\nFeatures\t: half thumb neon\nHardware\t: aes board\n", CHACHA),
        ("flags\t\t: fpu vaes_not\n", CHACHA),
        (None, CHACHA),
    ],
    ids=["x86", "arm64", "arm without", "similar word", "unreadable"],
)
def test_aes_is_preferred_where_the_cpu_has_it(cpuinfo: Path, text: str | None, first: Cipher) -> None:
    if text is not None:
        cpuinfo.write_text(text)
    assert offered_ciphers()[0] is first
    assert set(offered_ciphers()) == set(Cipher)


def test_parameters_travel_in_an_envelope_and_are_not_printed() -> None:
    drawn = SessionParameters.draw(7, CHACHA, 5555)
    assert SessionParameters.from_envelope(decode_envelope(encode_envelope(drawn.to_envelope()))) == drawn
    assert drawn.secret.hex() not in repr(drawn) and repr(drawn.secret) not in repr(drawn)
    assert SessionParameters.draw(7, CHACHA, 5555).secret != drawn.secret


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("sid", -1),
        ("sid", 2**32),
        ("sid", None),
        ("secret", "00" * 31),
        ("secret", "00" * 33),
        ("secret", "zz" * 32),
        ("secret", 5),
        ("cipher", "rot13"),
        ("port", 0),
        ("port", 65536),
    ],
)
def test_bad_parameters_are_refused_without_telling_the_secret(key: str, value: object) -> None:
    envelope = {**parameters().to_envelope(), key: value}
    with pytest.raises(WireError) as error:
        SessionParameters.from_envelope(envelope)
    assert SECRET.hex() not in str(error.value)


def test_a_secret_of_another_length_is_the_callers_mistake() -> None:
    with pytest.raises(UsageError, match="32 bytes"):
        parameters(secret=b"short")


@pytest.mark.parametrize("cipher", Cipher)
def test_an_opener_asks_for_a_rekey_before_the_other_sides_key_is_used_up(cipher: Cipher) -> None:
    """Whoever looks sees it: the counter is there to be read."""
    drawn = SessionParameters.draw(7, cipher, 5555)
    sealer, opener = Sealer(drawn, Side.RELAY), Opener(drawn, Side.RELAY)
    due = int(REKEY_SHARE * SEAL_LIMITS[cipher])
    sealer.counter = due - 2
    seen = []
    for _ in range(2):
        assert opener.open(sealer.seal(b"x")) == b"x"
        seen.append((opener.rekey_due, sealer.rekey_due))
    assert seen == [(False, False), (True, True)]
