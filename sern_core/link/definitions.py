"""Texts of message definitions by their hash: each is kept once in a process, while a stream uses it, and not longer.

A text is used by the streams that name it: those that the peers of all links have announced, and those that are offered
to them. What one peer makes us keep in this way is bounded in bytes, over all its sessions. The last few texts of
streams that have ended stay for the rest of the session, as topics come and go.
"""

from collections import OrderedDict
from collections.abc import Hashable
from typing import Final

from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import ClientName
from sern_core.wire.announce import definition_hash

MAX_DEFINITIONS: Final = 16_384
"""Texts that a process keeps, of all its peers."""
MAX_PEER_DEFINITIONS: Final = 2048
"""Questions for texts that a peer may leave unanswered for streams that have ended."""
LINGERING_TEXTS: Final = 64
LINGERING_BYTES: Final = 256 * 2**10
"""Texts of streams of one peer that have ended, kept while its session lasts."""


class DefinitionStore:
    """The texts of a process, shared by its links."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        self._uses: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._texts)

    def __contains__(self, digest: object) -> bool:
        return digest in self._texts

    def get(self, digest: str, default: str = "") -> str:
        return self._texts.get(digest, default)

    def values(self) -> list[str]:
        return list(self._texts.values())

    def use(self, digest: str) -> None:
        """One more stream names this text, whether it is here or not."""
        self._uses[digest] = self._uses.get(digest, 0) + 1

    def release(self, digest: str) -> None:
        """One stream less; with the last one the text goes."""
        left = self._uses[digest] - 1
        if left:
            self._uses[digest] = left
        else:
            del self._uses[digest]
            self._texts.pop(digest, None)

    def put(self, digest: str, text: str) -> None:
        """Keep the text if a stream uses it."""
        if digest in self._uses and len(self._texts) < MAX_DEFINITIONS:
            self._texts.setdefault(digest, text)

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self._texts.keys() <= self._uses.keys(), "definitions that nobody uses"
        assert all(count > 0 for count in self._uses.values()), "definitions used less than never"


class _Users:
    """Which of one link's streams, or channels, name which digest."""

    def __init__(self) -> None:
        self.digests: dict[Hashable, str] = {}
        self.counts: dict[str, int] = {}

    def set(self, user: Hashable, digest: str) -> tuple[str, str]:
        """`user` names `digest` ("": none) from now on. Returns the digest that is used by one of these for the first
        time, and the one that none uses any more; empty where there is none."""
        before = self.digests.pop(user, "")
        if digest:
            self.digests[user] = digest
        if before == digest:
            return "", ""
        first = last = ""
        if digest:
            self.counts[digest] = self.counts.get(digest, 0) + 1
            first = digest if self.counts[digest] == 1 else ""
        if before:
            self.counts[before] -= 1
            if not self.counts[before]:
                del self.counts[before]
                last = before
        return first, last


class PeerDefinitions:
    """What one link has to do with definitions: which its streams use, which were asked for, told, and are awaited."""

    def __init__(self, store: DefinitionStore, peer: ClientName, *, max_bytes: int) -> None:
        self.store = store
        self.peer = peer
        self._max_bytes = max_bytes
        self.bytes = 0
        """Texts that the peer's streams use, lingering ones included."""
        self._in = _Users()
        self._out = _Users()
        self._charged: dict[str, int] = {}  # bytes of the texts in `bytes`
        self._lingering: OrderedDict[str, None] = OrderedDict()  # the oldest first
        self._asked: set[str] = set()  # the peer asked for it before it was here
        self._told: set[str] = set()  # the peer has had it in the session
        self._needed: dict[str, None] = {}  # we asked the peer for it in the session; not here yet

    def begin(self) -> None:
        """A session has begun: nothing has been asked or told."""
        self._asked.clear()
        self._told.clear()
        self._needed.clear()
        self._let_go(0, 0)

    def close(self) -> None:
        """The link is given up, and all its streams."""
        for user in list(self._in.digests):
            self.use_incoming(user, "")
        for user in list(self._out.digests):
            self.use_outgoing(user, "")
        self.begin()

    # --- streams --------------------------------------------------------------------------------------------------

    def use_incoming(self, user: Hashable, digest: str) -> None:
        """A stream of the peer names this digest; "": it has none, or has ended. Raises WireError when the peer's
        streams use too much."""
        first, last = self._in.set(user, digest)
        if first:
            self.store.use(first)
            if first in self._lingering:
                del self._lingering[first]
                self.store.release(first)
            self._charge(first)
        if last:
            if last in self.store:
                self._lingering[last] = None
                self._let_go(LINGERING_TEXTS, LINGERING_BYTES)
            else:
                self.store.release(last)
        if self.bytes > self._max_bytes:
            raise WireError(f"the streams of {self.peer} use more than {self._max_bytes} bytes of definitions")

    def use_outgoing(self, user: Hashable, digest: str, text: str = "") -> None:
        """A stream that is offered to the peer names this digest; "": it has none, or has ended."""
        first, last = self._out.set(user, digest)
        if first:
            self.store.use(first)
        if digest and text:
            self.store.put(digest, text)
        if last:
            self.store.release(last)
            self._asked.discard(last)
            self._told.discard(last)

    def _charge(self, digest: str) -> None:
        if digest not in self._charged and digest in self.store:
            self._charged[digest] = len(self.store.get(digest).encode())
            self.bytes += self._charged[digest]

    def _let_go(self, texts: int, nbytes: int) -> None:
        """Keep at most so many lingering texts: release the oldest, which until now the last stream's use stood for."""
        held_bytes = sum(self._charged.get(digest, 0) for digest in self._lingering)
        while len(self._lingering) > texts or held_bytes > nbytes:
            digest, _none = self._lingering.popitem(last=False)
            size = self._charged.pop(digest, 0)
            held_bytes -= size
            self.bytes -= size
            self.store.release(digest)

    # --- questions and answers --------------------------------------------------------------------------------------

    def lacks(self, digest: str) -> bool:
        """A stream of the peer names this digest. Whether to ask for it: it is not here, and was not asked for yet."""
        if digest in self.store or digest in self._needed:
            return False
        self._needed[digest] = None
        if len(self._needed) > MAX_PEER_DEFINITIONS + len(self._in.counts):
            stale = next((each for each in self._needed if each not in self._in.counts), None)
            if stale is not None:
                del self._needed[stale]
        return True

    def asked(self, digest: str) -> str | None:
        """The peer asks for a text: the text if it is to be told now. One that no stream of ours names is not told:
        its stream has ended meanwhile."""
        if digest not in self._out.counts or digest in self._told:
            return None
        if digest not in self.store:
            self._asked.add(digest)
            return None
        self._told.add(digest)
        return self.store.get(digest)

    def peer_asked(self, user: Hashable) -> bool:
        """Whether the peer has asked, since the link came up, for the text that this stream of ours uses."""
        digest = self._out.digests.get(user)
        return digest is not None and (digest in self._asked or digest in self._told)

    def known(self, digest: str) -> str | None:
        """A text is here, from whomever: the text if this peer waits for it."""
        if digest in self._in.counts:
            self._charge(digest)
        if digest not in self._asked:
            return None
        self._asked.discard(digest)
        return self.asked(digest)

    def came(self, digest: str, attachment: bytes) -> bool:
        """The peer's answer. True: streams wait for it. Raises WireError for one that no honest peer sends."""
        try:
            text = attachment.decode()
        except UnicodeDecodeError as error:
            raise WireError("a message definition is not UTF-8") from error
        if definition_hash(text) != digest:
            raise WireError("a message definition does not match its hash")
        if digest not in self._needed:
            raise WireError(f"{self.peer} defines {digest}, which it was not asked for")
        del self._needed[digest]
        if digest not in self._in.counts:
            return False  # its stream has ended
        if digest in self.store:
            return True
        if self.bytes + len(attachment) > self._max_bytes:
            raise WireError(f"{self.peer} sends more than {self._max_bytes} bytes of definitions for its streams")
        self.store.put(digest, text)
        self._charge(digest)
        return True

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self._charged.keys() <= self._in.counts.keys() | self._lingering.keys(), "bytes of definitions unused"
        assert self.bytes == sum(self._charged.values()), "bytes of definitions"
        assert self._told | self._asked <= self._out.counts.keys(), "definitions told of streams that have ended"
        assert self._in.counts.keys().isdisjoint(self._lingering), "a definition in use lingers"
