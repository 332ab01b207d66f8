"""Sealing of UDP datagrams: an AEAD under keys of one session and direction, and a window against replays.

    0                   1                   2                   3
    0 1 2 3 4 5 6 7 8 9 0 1 2 3 4 5 6 7 8 9 0 1 2 3 4 5 6 7 8 9 0 1
   +---------------------------------------------------------------+
   | session id                                                    |  clear, authenticated
   +---------------------------------------------------------------+
   | counter, from 1, never used twice in a session and direction  |  clear, authenticated
   |                                                               |
   +---------------------------------------------------------------+
   | ciphertext of the inner datagram, as long as the datagram ... |
   +---------------------------------------------------------------+
   | tag, 16 bytes                                                 |
   |                                                               |
   |                                                               |
   |                                                               |
   +---------------------------------------------------------------+

Integers are big endian. The nonce is the direction's 4-byte salt and the 8 bytes of the counter; the 12 clear bytes
are the associated data. The whole is at most `UDP_PAYLOAD_BYTES`.

Keys: for each session the relay draws an id and a 32-byte secret and sends both over the ZMQ lane, inside CURVE. For
each direction, HKDF-SHA256 (RFC 5869; no salt, input the secret) with the info

    "sern udp 1 " + ("client" or "relay", who seals) + " " + cipher name + session id as u32

gives 36 bytes: the key (32) and the nonce's salt (4). So nothing sealed by one side, for one session, or with one
cipher opens as anything else. A session ends with the connection that carried its secret, and before it has sealed as
much as its cipher allows (RFC 9001, 6.6 and B.1); the next one has another secret. The client asks for it when three
quarters are used up of either key: it sees the relay's counter in what it opens.
"""

import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Final, Self

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from sern_core.vocabulary.errors import RefusedError, SernError, UsageError, WireError
from sern_core.wire import framing

UDP_PAYLOAD_BYTES: Final = 1200
"""Largest UDP payload: what every IPv6 path (1280) and nearly every tunnel carries whole (RFC 9000, 14)."""
CLEAR: Final = struct.Struct("!IQ")
CLEAR_BYTES: Final = CLEAR.size
TAG_BYTES: Final = 16
SEAL_BYTES: Final = CLEAR_BYTES + TAG_BYTES
"""What sealing adds."""
ROOM_BYTES: Final = UDP_PAYLOAD_BYTES - SEAL_BYTES
"""The largest data that can be sealed."""
SECRET_BYTES: Final = 32
KEY_BYTES: Final = 32
SALT_BYTES: Final = 4
REPLAY_WINDOW: Final = 1024
"""How far behind the newest counter a datagram may arrive: reordering of about 100 ms at 100 Mbit/s."""
_WINDOW_MASK: Final = (1 << REPLAY_WINDOW) - 1
_CPUINFO: Final = Path("/proc/cpuinfo")


class Cipher(StrEnum):
    AES_256_GCM = "aes-256-gcm"
    CHACHA20_POLY1305 = "chacha20-poly1305"


SEAL_LIMITS: Final = {Cipher.AES_256_GCM: 2**28, Cipher.CHACHA20_POLY1305: 2**48}
"""Datagrams that one key may seal: RFC 9001, B.1.1 for AES-GCM and packets below 2^11 bytes; ChaCha20 has no bound
that matters. 2^28 are 7 hours at 100 Mbit/s, and a week at 4."""
FORGERY_LIMITS: Final = {Cipher.AES_256_GCM: 2**52, Cipher.CHACHA20_POLY1305: 2**36}
"""Bad tags after which a key is no longer believed (RFC 9001, 6.6)."""
REKEY_SHARE: Final = 0.75
"""At this share of a limit it is time for a new session."""


class RekeyError(SernError):
    """A session has sealed all that its key allows. Open another one."""


class Side(StrEnum):
    """Who seals: names a direction."""

    CLIENT = "client"
    RELAY = "relay"

    @property
    def other(self) -> "Side":
        return Side.RELAY if self is Side.CLIENT else Side.CLIENT


@cache
def has_aes_instructions() -> bool:
    """Whether this CPU computes AES in hardware, as Linux tells (x86 `flags`, ARM `Features`). Unknown: no."""
    try:
        text = _CPUINFO.read_text(errors="replace")
    except OSError:
        return False
    return any(
        "aes" in words.split()
        for name, _, words in (line.partition(":") for line in text.splitlines())
        if name.strip() in ("flags", "Features")
    )


def offered_ciphers() -> tuple[Cipher, ...]:
    """What this side can do, the fastest first: 0.65 µs a datagram with AES instructions, 1.2 µs ChaCha20; AES
    without the instructions costs several times that."""
    if has_aes_instructions():
        return (Cipher.AES_256_GCM, Cipher.CHACHA20_POLY1305)
    return (Cipher.CHACHA20_POLY1305, Cipher.AES_256_GCM)


def choose_cipher(offered: Sequence[str], own: Sequence[Cipher] | None = None) -> Cipher:
    """The relay's choice: what both put first, else ChaCha20-Poly1305, which no side computes badly, else any in
    common. Names unknown here are passed over. Raises RefusedError (code `cipher`)."""
    mine = offered_ciphers() if own is None else own
    common = [cipher for cipher in mine if cipher.value in offered]
    if not common:
        raise RefusedError("cipher", "no UDP cipher in common; update the side that is older")
    theirs = next(name for name in offered if name in common)
    if common[0].value == theirs or Cipher.CHACHA20_POLY1305 not in common:
        return common[0]
    return Cipher.CHACHA20_POLY1305


@dataclass(frozen=True, slots=True)
class SessionParameters:
    """What both sides know of one session. Goes to the client over the ZMQ lane, which keeps `secret` secret."""

    id: int  # u32
    secret: bytes = field(repr=False)  # SECRET_BYTES
    cipher: Cipher
    port: int  # the relay's UDP port

    def __post_init__(self) -> None:
        if len(self.secret) != SECRET_BYTES:
            raise UsageError(f"a session secret has {SECRET_BYTES} bytes, not {len(self.secret)}")

    @classmethod
    def draw(cls, session_id: int, cipher: Cipher, port: int) -> Self:
        return cls(session_id, os.urandom(SECRET_BYTES), cipher, port)

    def to_envelope(self) -> framing.Envelope:
        """Keys `sid`, `secret` (hexadecimal), `cipher` and `port`, for a control message."""
        return {"sid": self.id, "secret": self.secret.hex(), "cipher": self.cipher.value, "port": self.port}

    @classmethod
    def from_envelope(cls, envelope: framing.Envelope) -> Self:
        """Raises WireError."""
        try:
            secret = bytes.fromhex(framing.take_str(envelope, "secret", max_length=2 * SECRET_BYTES))
            cipher = Cipher(framing.take_str(envelope, "cipher", max_length=64))
            return cls(
                framing.take_int(envelope, "sid", high=0xFFFFFFFF),
                secret,
                cipher,
                framing.take_int(envelope, "port", low=1, high=0xFFFF),
            )
        except (ValueError, UsageError):
            raise WireError("the parameters of a UDP session are not valid") from None  # names no part of the secret


class Sealer:
    """Seals what one side of one session sends."""

    __slots__ = ("_encrypt", "_id", "_limit", "_room_bytes", "_salt", "counter")

    def __init__(
        self, parameters: SessionParameters, side: Side, *, limit: int | None = None, room_bytes: int = ROOM_BYTES
    ) -> None:
        """`limit`: datagrams this key may seal, at most (and by default) its cipher's of `SEAL_LIMITS`. `room_bytes`:
        what one of them may have inside; what is above a few kB is for ChaCha20, whose limit does not depend on it."""
        key, self._salt = _derive(parameters, side)
        self._encrypt = _aead(parameters.cipher, key).encrypt
        self._id = parameters.id
        self._room_bytes = room_bytes
        self._limit = min(limit or SEAL_LIMITS[parameters.cipher], SEAL_LIMITS[parameters.cipher])
        self.counter = 0
        """Datagrams sealed so far, and the counter of the newest."""

    @property
    def rekey_due(self) -> bool:
        """Time to open another session."""
        return self.counter >= REKEY_SHARE * self._limit

    @property
    def exhausted(self) -> bool:
        return self.counter >= self._limit

    def seal(self, data: bytes) -> bytes:
        """The datagram for `data`, of at most `room_bytes`. Raises RekeyError once the key is used up."""
        if len(data) > self._room_bytes:
            raise UsageError(f"{len(data)} bytes do not fit a datagram: at most {self._room_bytes}")
        counter = self.counter + 1
        if counter > self._limit:
            raise RekeyError(f"the key of UDP session {self._id:#010x} has sealed {self._limit} datagrams; rekey")
        self.counter = counter
        clear = CLEAR.pack(self._id, counter)
        return clear + self._encrypt(self._salt + clear[4:], data, clear)


class Opener:
    """Opens what the other side of one session sealed, each datagram once.

    The window moves on authenticated datagrams only. Counts of what was refused: `short`, `foreign` (another session's
    id), `old` (behind the window), `replayed`, `bad_tags`.
    """

    __slots__ = (
        "_decrypt",
        "_forgery_limit",
        "_id",
        "_mask",
        "_salt",
        "_seal_limit",
        "bad_tags",
        "foreign",
        "highest",
        "old",
        "replayed",
        "short",
    )

    def __init__(self, parameters: SessionParameters, side: Side, *, forgery_limit: int | None = None) -> None:
        """`side`: who sealed. `forgery_limit`: by default its cipher's of `FORGERY_LIMITS`."""
        key, self._salt = _derive(parameters, side)
        self._decrypt = _aead(parameters.cipher, key).decrypt
        self._id = parameters.id
        self._forgery_limit = forgery_limit or FORGERY_LIMITS[parameters.cipher]
        self._seal_limit = SEAL_LIMITS[parameters.cipher]
        self._mask = 1  # bit i: counter highest - i has arrived; 0 is no counter, so it counts as seen
        self.highest = 0
        """The newest counter that was opened; 0 before the first."""
        self.short = 0
        self.foreign = 0
        self.old = 0
        self.replayed = 0
        self.bad_tags = 0

    @property
    def rekey_due(self) -> bool:
        """Time to open another session: because of forgeries, or because the other side's key is nearly used up."""
        return self.bad_tags >= REKEY_SHARE * self._forgery_limit or self.highest >= REKEY_SHARE * self._seal_limit

    @property
    def refused(self) -> Mapping[str, int]:
        """The counts by name, for metrics."""
        return {
            "short": self.short,
            "foreign": self.foreign,
            "old": self.old,
            "replayed": self.replayed,
            "bad_tag": self.bad_tags,
        }

    def open(self, datagram: bytes | memoryview) -> bytes | None:
        """What was sealed, or None for whatever else arrives. Raises nothing."""
        if len(datagram) < SEAL_BYTES:
            self.short += 1
            return None
        session_id, counter = CLEAR.unpack_from(datagram)
        if session_id != self._id:
            self.foreign += 1
            return None
        ahead = counter - self.highest
        if ahead <= 0:
            if ahead <= -REPLAY_WINDOW:
                self.old += 1
                return None
            if self._mask >> -ahead & 1:
                self.replayed += 1
                return None
        if self.bad_tags >= self._forgery_limit:
            return None
        clear = bytes(datagram[:CLEAR_BYTES])
        try:
            data = self._decrypt(self._salt + clear[4:], datagram[CLEAR_BYTES:], clear)
        except InvalidTag:
            self.bad_tags += 1
            return None
        if ahead > 0:
            # The bound comes first: a shift by a counter that a peer chose must not make a number of 2^60 bits.
            self._mask = (self._mask << ahead | 1) & _WINDOW_MASK if ahead < REPLAY_WINDOW else 1
            self.highest = counter
        else:
            self._mask |= 1 << -ahead
        return data


def make_seals(parameters: SessionParameters, side: Side) -> tuple[Sealer, Opener]:
    """What `side` seals with, and what it opens the other's datagrams with."""
    return Sealer(parameters, side), Opener(parameters, side.other)


def _derive(parameters: SessionParameters, side: Side) -> tuple[bytes, bytes]:
    """Key and nonce salt of one direction; see the module's text."""
    info = f"sern udp 1 {side.value} {parameters.cipher.value}".encode() + struct.pack("!I", parameters.id)
    material = HKDF(algorithm=SHA256(), length=KEY_BYTES + SALT_BYTES, salt=None, info=info).derive(parameters.secret)
    return material[:KEY_BYTES], material[KEY_BYTES:]


def _aead(cipher: Cipher, key: bytes) -> AESGCM | ChaCha20Poly1305:
    return AESGCM(key) if cipher is Cipher.AES_256_GCM else ChaCha20Poly1305(key)
