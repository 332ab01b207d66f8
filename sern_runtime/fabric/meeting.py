"""How two relays agree on keys through routers that they need not believe, and what they seal with them. No I/O.

    OFFER, ANSWER
    0                   1                   2                   3
    0 1 2 3 4 5 6 7 8 9 0 1 2 3 4 5 6 7 8 9 0 1 2 3 4 5 6 7 8 9 0 1
   +---------------+-----------------------------------------------+
   | kind          | boot of who sends, 8 bytes ...                |
   +---------------+-----------------------------------------------+
   | X25519 public key, 32 bytes, of this offer or answer alone    |
   +---------------------------------------------------------------+
   | the public key that is answered, 32 bytes; zeros in an OFFER  |
   +-------------------------------+-------------------------------+
   | length of the certificate     | certificate (DER) ...         |
   +-------------------------------+-------------------------------+
   | signature by the certificate's key (ECDSA, SHA-256), the rest |
   +---------------------------------------------------------------+

    ASK        kind, boot: "make me an offer"
    SEALED     kind, then a datagram of `sern_runtime.seal`, ChaCha20-Poly1305, whose data begins with what is inside:
               DATAGRAM, PROVE or PROVED

What is signed: "sern fabric meeting 1", the presence token of who sends and of whom it is for (names, boots, wire
versions, hashes of rules), the kind, both public keys, and the certificate as it is in the message. Nothing of it can
be used towards another relay, or of another process.

The relay whose name comes first makes an OFFER, again and again until it has the ANSWER to it. The shared secret of the
two public keys, HKDF-SHA256 with all that both have signed but the certificates as salt, gives the secret of a session
of `seal`; the one who offered seals as `Side.CLIENT`. Keys are of one meeting: recorded offers, answers and datagrams
are of no use later, since at least one of the two keys is new. Who offered knows by the ANSWER that the other is there,
and says PROVE until it opens something; who answered knows it by the first datagram that it opens, and until then goes
on with the keys that it had. So what a router makes up, alters or repeats opens nothing and ends nothing.
"""

import struct
from enum import IntEnum
from typing import Final, NamedTuple

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.hashes import SHA256, Hash
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from sern_core.wire.framing import MAX_DATAGRAM_BYTES
from sern_runtime.fabric.identity import Identity, StrangerError
from sern_runtime.fabric.keys import relay_token
from sern_runtime.fabric.port import FabricDrop, PeerRelay
from sern_runtime.seal import (
    CLEAR,
    SEAL_BYTES,
    SECRET_BYTES,
    Cipher,
    Opener,
    RekeyError,
    Sealer,
    SessionParameters,
    Side,
)

CONTEXT: Final = b"sern fabric meeting 1"
PUBLIC_BYTES: Final = 32
NOBODY: Final = bytes(PUBLIC_BYTES)
_HEAD: Final = struct.Struct("!BQ")
_CARD: Final = struct.Struct("!BQ32s32sH")
_ID: Final = struct.Struct("!I")
SEALING_BYTES: Final = 2 + SEAL_BYTES
"""What sealing adds to a datagram."""
OFFER_EVERY_S: Final = 0.2
"""At most one offer in such a time is answered anew: each costs a signature, and a router may repeat old ones."""


class Kind(IntEnum):
    OFFER = 1
    ANSWER = 2
    ASK = 3
    SEALED = 4


class Inside(IntEnum):
    """What is sealed."""

    DATAGRAM = 0
    PROVE = 1
    PROVED = 2


class Taken(NamedTuple):
    """What came of a message of the peer."""

    reply: bytes | None = None
    """To be sent to it now."""
    datagram: bytes | None = None
    """What was sealed for this relay's hop."""
    drop: FabricDrop | None = None
    problem: str = ""
    """Why it was dropped, where there is more to say than `drop` does."""


class _Session:
    """Keys of one meeting. `Sealer` and `Opener` of it."""

    __slots__ = ("expires_s", "id", "opener", "sealer")

    def __init__(self, parameters: SessionParameters, side: Side, expires_s: float) -> None:
        self.id = parameters.id
        self.expires_s = expires_s
        self.sealer = Sealer(parameters, side, room_bytes=1 + MAX_DATAGRAM_BYTES)
        self.opener = Opener(parameters, side.other)

    def seal(self, inside: Inside, data: bytes = b"") -> bytes:
        """Raises RekeyError."""
        return b"%c%b" % (Kind.SEALED, self.sealer.seal(b"%c%b" % (inside, data)))


class Meeting:
    """This relay's side of what it has with one process of another relay. `own` and `peer` as their tokens have them.

    `due` is to be sent now and again; `take` is given all that begins with a `Kind` of this peer. Times are of the
    monotonic clock, but for `at_s`, the seconds since 1970 by which certificates are judged.
    """

    def __init__(self, identity: Identity, own: PeerRelay, peer: PeerRelay) -> None:
        self.peer = peer
        self._identity = identity
        self._own = own
        self.offers = own.name < peer.name
        """Whether it is this side that makes offers."""
        self._offer: tuple[X25519PrivateKey, bytes] | None = None
        self._session: _Session | None = None
        self._next: _Session | None = None  # of who answered: not used by the other yet
        self._answered = NOBODY  # the public key in the latest offer or answer that was taken
        self._answer = b""
        self._answered_s = -OFFER_EVERY_S
        self._proved = False
        if self.offers:
            self._make_offer()

    @property
    def up(self) -> bool:
        """The other one has shown that it is there and has the key of its certificate."""
        return self._session is not None

    @property
    def settled(self) -> bool:
        """Nothing is `due`."""
        return self.up and self._offer is None and (self._proved or not self.offers)

    @property
    def expires_s(self) -> float:
        """When the certificate that was shown expires, in seconds since 1970; only while it is `up`."""
        assert self._session is not None
        return self._session.expires_s

    def end(self) -> None:
        """The keys are not used any more; there may be others."""
        self._session = self._next = None
        self._answered, self._answer, self._proved = NOBODY, b"", False
        if self.offers:
            self._make_offer()

    def due(self) -> bytes | None:
        """What the other is to be told until it has said something to it."""
        if self._offer is not None:
            return self._offer[1]
        if self._session is None:
            return _HEAD.pack(Kind.ASK, self._own.boot)
        return None if self.settled else self._session.seal(Inside.PROVE)

    def seal(self, datagram: bytes) -> bytes | None:
        """None: there are no keys, or they are used up, which takes longer than anybody waits."""
        if self._session is None:
            return None
        try:
            return self._session.seal(Inside.DATAGRAM, datagram)
        except RekeyError:
            self.end()
            return None

    def knows(self, message: bytes) -> bool:
        """Whether something SEALED says that it is sealed by keys that are known here."""
        return self._which(message) is not None

    def take(self, message: bytes, *, now: float, at_s: float) -> Taken:
        """`message`: not empty."""
        kind = message[0]
        if kind == Kind.SEALED:
            return self._open(message)
        if kind == Kind.ASK and len(message) == _HEAD.size:
            return self._asked()
        if kind == (Kind.OFFER if not self.offers else Kind.ANSWER) and len(message) > _CARD.size:
            try:
                return self._answers(message, at_s) if self.offers else self._offered(message, now, at_s)
            except StrangerError as error:
                return Taken(drop=FabricDrop.BAD_CARD, problem=str(error))
        return Taken(drop=FabricDrop.BAD_CARD, problem="it sends what no relay sends here")

    # --- offer and answer -------------------------------------------------------------------------------------------

    def _make_offer(self) -> None:
        key = X25519PrivateKey.generate()
        self._offer = key, self._card(Kind.OFFER, _public(key), NOBODY)

    def _card(self, kind: Kind, public: bytes, answered: bytes) -> bytes:
        certificate = self._identity.certificate
        signature = self._identity.sign(_signed(kind, self._own, self.peer, public, answered) + certificate)
        return _CARD.pack(kind, self._own.boot, public, answered, len(certificate)) + certificate + signature

    def _verify(self, message: bytes, at_s: float) -> tuple[bytes, bytes, float]:
        """Its public key, the one that it answers, and when its certificate expires. Raises StrangerError."""
        kind, boot, public, answered, length = _CARD.unpack_from(message)
        if boot != self.peer.boot:
            raise StrangerError("it is of another process of that relay")
        rest = message[_CARD.size :]
        certificate, signature = rest[:length], rest[length:]
        signed = _signed(Kind(kind), self.peer, self._own, public, answered) + certificate
        expires_s = self._identity.verify(certificate, self.peer.name, signed, signature, at_s=at_s)
        return public, answered, expires_s

    def _offered(self, message: bytes, now: float, at_s: float) -> Taken:
        public = _CARD.unpack_from(message)[2]
        if self._answer and public == self._answered:
            return Taken(reply=self._answer)
        if now - self._answered_s < OFFER_EVERY_S:
            return Taken(drop=FabricDrop.BAD_CARD, problem="offers come faster than a relay makes them")
        self._answered_s = now
        public, answered, expires_s = self._verify(message, at_s)
        if answered != NOBODY:
            raise StrangerError("its offer answers something")
        key = X25519PrivateKey.generate()
        self._next = self._agree(key, public, Side.RELAY, expires_s)
        self._answered, self._answer = public, self._card(Kind.ANSWER, _public(key), public)
        return Taken(reply=self._answer)

    def _answers(self, message: bytes, at_s: float) -> Taken:
        if self._answered != NOBODY and _CARD.unpack_from(message)[2] == self._answered:
            return Taken()  # to an offer that was sent twice
        if self._offer is None:
            return Taken(drop=FabricDrop.BAD_CARD, problem="it answers what nobody offered")
        public, answered, expires_s = self._verify(message, at_s)
        key, _ = self._offer
        if answered != _public(key):
            raise StrangerError("it answers another offer")
        self._session = self._agree(key, public, Side.CLIENT, expires_s)
        self._offer, self._answered, self._proved = None, public, False
        return Taken(reply=self._session.seal(Inside.PROVE))

    def _asked(self) -> Taken:
        """It has no keys. This may be somebody else's wish: those that there are stay until there is an answer."""
        if not self.offers:
            return Taken(drop=FabricDrop.BAD_CARD, problem="it asks for an offer, and is to make it")
        if self._offer is not None:
            return Taken()  # it is on its way
        self._make_offer()
        return Taken(reply=self.due())

    def _agree(self, key: X25519PrivateKey, other: bytes, side: Side, expires_s: float) -> _Session:
        """Raises StrangerError for a public key that gives no secret."""
        try:
            shared = key.exchange(X25519PublicKey.from_public_bytes(other))
        except ValueError:
            raise StrangerError("its public key is none") from None
        mine, theirs = _public(key), other
        first, second = (self._own, self.peer) if side is Side.CLIENT else (self.peer, self._own)
        offered, answered = (mine, theirs) if side is Side.CLIENT else (theirs, mine)
        salt = Hash(SHA256())
        salt.update(_signed(Kind.OFFER, first, second, offered, NOBODY))
        salt.update(_signed(Kind.ANSWER, second, first, answered, offered))
        length = SECRET_BYTES + _ID.size
        material = HKDF(algorithm=SHA256(), length=length, salt=salt.finalize(), info=CONTEXT).derive(shared)
        (number,) = _ID.unpack(material[SECRET_BYTES:])
        parameters = SessionParameters(number, material[:SECRET_BYTES], Cipher.CHACHA20_POLY1305, port=0)
        return _Session(parameters, side, expires_s)

    # --- what is sealed ---------------------------------------------------------------------------------------------

    def _open(self, message: bytes) -> Taken:
        session = self._which(message)
        if session is None:
            return Taken(drop=FabricDrop.UNSEALED)
        opener = session.opener
        data = opener.open(memoryview(message)[1:])
        if data is None:
            return Taken(drop=FabricDrop.BAD_SEAL)
        if session is self._next:
            self._session, self._next = session, None
        self._proved = True
        if not data:
            return Taken(drop=FabricDrop.BAD_SEAL)
        if data[0] == Inside.DATAGRAM:
            return Taken(datagram=data[1:])
        return Taken(reply=session.seal(Inside.PROVED) if data[0] == Inside.PROVE else None)

    def _which(self, message: bytes) -> _Session | None:
        """The keys by which it says that it is sealed. None: by none that are known here."""
        if len(message) < 1 + SEAL_BYTES:
            return None
        (number, _) = CLEAR.unpack_from(message, 1)
        for session in (self._session, self._next):
            if session is not None and session.id == number:
                return session
        return None


def boot_of(message: bytes) -> int | None:
    """The process that an OFFER, ANSWER or ASK says it is of; None: it is none of these."""
    if len(message) < _HEAD.size or message[0] not in (Kind.OFFER, Kind.ANSWER, Kind.ASK):
        return None
    boot: int = _HEAD.unpack_from(message)[1]
    return boot


def _public(key: X25519PrivateKey) -> bytes:
    return key.public_key().public_bytes_raw()


def _signed(kind: Kind, source: PeerRelay, destination: PeerRelay, public: bytes, answered: bytes) -> bytes:
    """No part of a token has a zero byte, and what follows the tokens is of fixed length: one meaning each."""
    tokens = (relay_token(each).encode() for each in (source, destination))
    return b"\0".join((CONTEXT, *tokens, b"%c%b%b" % (kind, public, answered)))
