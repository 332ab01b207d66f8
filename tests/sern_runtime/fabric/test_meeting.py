"""Two relays agree on keys, and whatever is altered, repeated, or somebody else's opens nothing."""

import datetime
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from random import Random

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from hypothesis import given
from hypothesis import strategies as st

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import ClientName
from sern_core.wire.framing import MAX_DATAGRAM_BYTES
from sern_runtime.fabric.identity import CERTIFICATE_BYTES, SIGNATURE_BYTES, Identity, StrangerError
from sern_runtime.fabric.meeting import OFFER_EVERY_S, SEALING_BYTES, Kind, Meeting, Taken, boot_of
from sern_runtime.fabric.port import FabricDrop, PeerRelay
from sern_runtime.seal import REPLAY_WINDOW
from tests.sern_runtime.fabric.relays import A, B, C, files

NOW_S = datetime.datetime.now(datetime.UTC).timestamp()
YEAR_S = 365 * 86_400.0
CLEAR = b"\x07" * 16
"""By chance in no sealed datagram: three bytes are in one of 250 of the greatest size."""
REFUSED = {FabricDrop.BAD_CARD, FabricDrop.BAD_SEAL, FabricDrop.UNSEALED}


def token(name: ClientName, *, boot: int = 1, rules: str = "") -> PeerRelay:
    return PeerRelay(name, boot, (1, 1), rules)


class World:
    """Time goes on with each message, so that offers are never too frequent."""

    def __init__(self, folder: Path) -> None:
        self.identities = {name: Identity.read(files(folder, name)) for name in (A, B, C)}
        self.now = 0.0
        self.at_s = NOW_S

    def meeting(self, own: PeerRelay, peer: PeerRelay, *, identity: Identity | None = None) -> Meeting:
        return Meeting(identity or self.identities[own.name], own, peer)

    def pair(self, first: PeerRelay, second: PeerRelay) -> tuple[Meeting, Meeting]:
        return self.meeting(first, second), self.meeting(second, first)

    def take(self, meeting: Meeting, message: bytes | None) -> Taken:
        assert message is not None
        self.now += 2 * OFFER_EVERY_S
        return meeting.take(message, now=self.now, at_s=self.at_s)

    def agree(self, first: Meeting, second: Meeting) -> list[bytes]:
        """What was said, in turns; the first is the one that offers."""
        said = [first.due()]
        for taker in (second, first, second, first):
            taken = self.take(taker, said[-1])
            assert taken.drop is None, taken
            said.append(taken.reply)
        assert said.pop() is None and first.up and second.up and first.settled and second.settled
        return [message for message in said if message is not None]

    def agreed(self) -> tuple[Meeting, Meeting]:
        first, second = self.pair(token(A), token(B))
        self.agree(first, second)
        return first, second


@pytest.fixture
def world(certificates: Path) -> World:
    return World(certificates)


def seal(meeting: Meeting, datagram: bytes) -> bytes:
    sealed = meeting.seal(datagram)
    assert sealed is not None
    return sealed


def altered(message: bytes, index: int) -> bytes:
    return message[:index] + bytes((message[index] ^ 1,)) + message[index + 1 :]


def test_they_agree_and_datagrams_go_both_ways(world: World) -> None:
    first, second = world.pair(token(A, rules="aa"), token(B, boot=2**63 - 1))
    assert not first.up and not second.up and first.seal(b"x") is None
    said = world.agree(first, second)
    assert [message[0] for message in said] == [Kind.OFFER, Kind.ANSWER, Kind.SEALED, Kind.SEALED]
    assert first.due() is None and second.due() is None
    for sender, receiver in ((first, second), (second, first)):
        for size in (0, 1, 1171, MAX_DATAGRAM_BYTES):
            sealed = seal(sender, b"\x07" * size)
            assert len(sealed) == size + SEALING_BYTES
            assert size < len(CLEAR) or CLEAR not in sealed
            assert world.take(receiver, sealed) == Taken(datagram=b"\x07" * size)
    assert first.expires_s == second.expires_s > NOW_S + 9 * YEAR_S


def test_the_same_datagram_is_never_sealed_alike(world: World) -> None:
    first, second = world.agreed()
    assert len({seal(meeting, b"same") for meeting in (first, second) for _ in range(50)}) == 100


def test_a_byte_that_is_altered_opens_nothing(world: World) -> None:
    first, second = world.agreed()
    sealed = seal(first, b"a command")
    for index in range(len(sealed)):
        taken = world.take(second, altered(sealed, index))
        assert taken.datagram is None and taken.reply is None and taken.drop in REFUSED, index
    assert world.take(second, sealed).datagram == b"a command"


def test_a_byte_that_is_altered_makes_no_keys(world: World) -> None:
    first, second = world.pair(token(A), token(B))
    offer = first.due()
    assert offer is not None
    for index in range(len(offer)):
        taken = world.take(second, altered(offer, index))
        assert taken.reply is None and taken.drop in REFUSED, index
    answer = world.take(second, offer).reply
    assert answer is not None
    for index in range(len(answer)):
        taken = world.take(first, altered(answer, index))
        assert not first.up and taken.reply is None and taken.drop in REFUSED, index
    world.take(first, answer)
    assert first.up


def test_what_comes_twice_or_in_another_order(world: World) -> None:
    """Everything within the window is opened once, in whatever order; what is older is not."""
    first, second = world.agreed()
    bodies = [b"%d" % number for number in range(REPLAY_WINDOW)]
    sealed = {body: seal(first, body) for body in bodies}
    Random(1).shuffle(bodies)
    assert [world.take(second, sealed[body]).datagram for body in bodies] == bodies
    assert {world.take(second, sealed[body]).drop for body in bodies} == {FabricDrop.BAD_SEAL}
    late = seal(first, b"late")
    for _ in range(REPLAY_WINDOW):
        world.take(second, seal(first, b"newer"))
    assert world.take(second, late).drop is FabricDrop.BAD_SEAL


def test_what_is_anothers_opens_nothing(world: World) -> None:
    """A router gives it to another relay, says that it is of another one, or sends it back."""
    first, second = world.agreed()
    others = world.pair(token(A), token(C))
    world.agree(*others)
    for_c, of_c = others[1], world.meeting(token(B), token(C))
    sealed = seal(first, b"for b alone")
    assert world.take(for_c, sealed).drop is FabricDrop.UNSEALED
    assert world.take(of_c, sealed).drop is FabricDrop.UNSEALED
    assert world.take(first, sealed).drop is FabricDrop.BAD_SEAL, "its own key is for the other direction"
    assert world.take(second, sealed).datagram == b"for b alone"


def test_an_offer_for_one_relay_is_none_for_another(world: World) -> None:
    first, _ = world.pair(token(A), token(B))
    taken = world.take(world.meeting(token(C), token(A)), first.due())
    assert taken == Taken(drop=FabricDrop.BAD_CARD, problem="its signature is not by the key of its certificate")


@pytest.mark.parametrize("which", ["rules", "versions", "boot"])
def test_presence_that_a_router_has_altered_makes_no_keys(world: World, which: str) -> None:
    """What it says of either of the two."""
    honest = {A: token(A, rules="aa"), B: token(B, rules="aa")}
    for name in (A, B):
        forged = {
            "rules": honest[name]._replace(rules="bb"),
            "versions": honest[name]._replace(wire_versions=(1, 9)),
            "boot": honest[name]._replace(boot=2),
        }[which]
        first = world.meeting(honest[A], forged if name == B else honest[B])
        second = world.meeting(honest[B], forged if name == A else honest[A])
        taken = world.take(second, first.due())
        assert taken.drop is FabricDrop.BAD_CARD and taken.reply is None and not second.up


@pytest.mark.parametrize(
    ("at_s", "problem"),
    [
        (NOW_S + 11 * YEAR_S, "its certificate, or that of its authority, is not valid now"),
        (NOW_S - YEAR_S, "its certificate, or that of its authority, is not valid now"),
    ],
    ids=["expired", "not yet"],
)
def test_a_certificate_of_another_time(world: World, at_s: float, problem: str) -> None:
    first, second = world.pair(token(A), token(B))
    world.at_s = at_s
    assert world.take(second, first.due()) == Taken(drop=FabricDrop.BAD_CARD, problem=problem)
    world.at_s = NOW_S
    answer = world.take(second, first.due()).reply
    world.at_s = at_s
    assert world.take(first, answer) == Taken(drop=FabricDrop.BAD_CARD, problem=problem) and not first.up


FOREIGN, NAMES_C, KEY_OF_C = (
    "its certificate was not signed by the authority in ca.pem",
    "its certificate is of relay_c",
    "its signature is not by the key of its certificate",
)


@pytest.mark.parametrize("problem", [FOREIGN, NAMES_C, KEY_OF_C])
def test_certificates_that_are_not_right(world: World, certificates: Path, foreign: Path, problem: str) -> None:
    """Of who offers, and of who answers."""

    def pretending(name: ClientName) -> Identity:
        """It believes the right authority, so that it answers."""
        theirs = {
            FOREIGN: replace(files(foreign, name), ca=files(certificates, name).ca),
            NAMES_C: files(certificates, C),
            KEY_OF_C: files(certificates, name, key_of=C),
        }
        return Identity.read(theirs[problem])

    first, second = world.pair(token(A), token(B))
    stranger = world.meeting(token(A), token(B), identity=pretending(A))
    assert world.take(second, stranger.due()) == Taken(drop=FabricDrop.BAD_CARD, problem=problem)
    stranger = world.meeting(token(B), token(A), identity=pretending(B))
    answer = world.take(stranger, first.due()).reply
    assert world.take(first, answer) == Taken(drop=FabricDrop.BAD_CARD, problem=problem)
    assert not first.up and not second.up


def test_one_of_two_authorities_is_enough(world: World, certificates: Path, foreign: Path, tmp_path: Path) -> None:
    """While the authority is replaced, ca.pem holds both."""
    both = tmp_path / "ca.pem"
    both.write_bytes((certificates / "ca.pem").read_bytes() + (foreign / "ca.pem").read_bytes())
    for name, folder in ((A, certificates), (B, foreign)):
        world.identities[name] = Identity.read(replace(files(folder, name), ca=both))
    world.agreed()


def test_an_old_process_and_all_that_it_said(world: World) -> None:
    """A router has kept everything, and repeats it: to the new process, and in place of the new one of the other."""
    first, second = world.pair(token(A), token(B))
    said = world.agree(first, second)
    kept = [*said, seal(first, b"old"), seal(second, b"old")]
    new = world.meeting(token(A), token(B, boot=2)), world.meeting(token(B, boot=2), token(A))
    for message in kept:
        for meeting in new:
            taken = world.take(meeting, message)
            assert taken.datagram is None and taken.drop in REFUSED
    assert not any(meeting.up for meeting in new)
    world.agree(*new)
    # The presence of the old process again, at a relay that is still the same.
    again = world.meeting(token(B), token(A))
    for message in kept:
        assert world.take(again, message).datagram is None
    assert not again.up


def test_an_old_offer_changes_nothing(world: World) -> None:
    """It is answered, as it is right; but nobody has the key to make anything of that."""
    first, second = world.pair(token(A), token(B))
    said = world.agree(first, second)
    kept = [seal(first, b"kept %d" % number) for number in range(3)]
    first.end()
    second.end()
    world.agree(first, second)
    for message in (*said, *kept):
        taken = world.take(second, message)
        assert taken.datagram is None
        if taken.reply is not None:
            assert world.take(first, taken.reply).drop is FabricDrop.BAD_CARD
    assert world.take(second, seal(first, b"goes on")).datagram == b"goes on"
    assert world.take(first, seal(second, b"both ways")).datagram == b"both ways"


def test_old_offers_cost_one_signature_now_and_then(world: World) -> None:
    offers = [world.meeting(token(A), token(B)).due() for _ in range(3)]
    second = world.meeting(token(B), token(A))
    assert world.take(second, offers[0]).reply is not None
    for offer in offers[1:] * 10:
        assert offer is not None
        taken = second.take(offer, now=world.now + 0.9 * OFFER_EVERY_S, at_s=NOW_S)
        assert taken.reply is None and taken.drop is FabricDrop.BAD_CARD
    assert world.take(second, offers[1]).reply is not None


@pytest.mark.parametrize("lost", list(product([False, True], repeat=6)))
def test_what_is_lost_is_said_again(world: World, lost: Sequence[bool]) -> None:
    """The first six messages arrive or do not; after that all do."""
    first, second = world.pair(token(A), token(B))
    fates = iter(lost)
    for _ in range(12):
        for sender, receiver in ((first, second), (second, first)):
            message = sender.due()
            while message is not None:
                if next(fates, False):
                    break
                message = world.take(receiver, message).reply
                sender, receiver = receiver, sender
    assert first.settled and second.settled
    assert world.take(second, seal(first, b"x")).datagram == b"x"
    assert world.take(first, seal(second, b"y")).datagram == b"y"


def test_who_has_lost_its_keys_asks_and_the_other_keeps_its_own_until_then(world: World) -> None:
    first, second = world.agreed()
    second.end()
    ask = second.due()
    assert ask is not None and ask[0] == Kind.ASK and boot_of(ask) == 1
    offer = world.take(first, ask).reply
    assert first.up and world.take(first, ask) == Taken(), "the offer is on its way"
    answer = world.take(second, offer).reply
    prove = world.take(first, answer).reply
    assert world.take(second, prove).reply is not None and second.up
    assert world.take(second, seal(first, b"x")).datagram == b"x"
    assert world.take(second, ask).drop is FabricDrop.BAD_CARD, "who answers is not asked"


def test_nobody_offered(world: World) -> None:
    first, second = world.pair(token(A), token(B))
    said = world.agree(first, second)
    assert world.take(first, said[1]) == Taken(), "the same answer again is that to an offer that was sent twice"
    stranger = world.meeting(token(B), token(A))
    answer = world.take(stranger, said[0]).reply
    assert world.take(first, answer).problem == "it answers what nobody offered"


ANYTHING = st.binary(min_size=1, max_size=300)
NEARLY = st.builds(lambda kind, rest: bytes([kind]) + rest, st.integers(0, 5), st.binary(max_size=300))


@given(ANYTHING | NEARLY)
def test_any_bytes_are_refused(certificates: Path, message: bytes) -> None:
    world = World(certificates)
    boot_of(message)
    for meeting in world.pair(token(A), token(B)):
        taken = world.take(meeting, message)
        assert not meeting.up and taken.datagram is None
        assert taken.drop in REFUSED or message[0] == Kind.ASK


def test_files_that_are_not_right_are_one_line(certificates: Path, tmp_path: Path) -> None:
    right = files(certificates, A)
    with pytest.raises(ConfigError, match=r"none.pem: can not be read: No such file"):
        Identity.read(replace(right, ca=tmp_path / "none.pem"))
    (tmp_path / "text.pem").write_text("none")
    with pytest.raises(ConfigError, match=r"text.pem: is no certificate or key in PEM"):
        Identity.read(replace(right, certificate=tmp_path / "text.pem"))
    key = Ed25519PrivateKey.generate().private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    (tmp_path / "ed.pem").write_bytes(key)
    with pytest.raises(ConfigError, match=r"ed.pem: is no key of ECDSA"):
        Identity.read(replace(right, key=tmp_path / "ed.pem"))


def test_what_is_larger_than_any_of_ours_is_not_read(world: World) -> None:
    for certificate, signature in ((bytes(CERTIFICATE_BYTES + 1), b""), (b"", bytes(SIGNATURE_BYTES + 1))):
        with pytest.raises(StrangerError, match="too large"):
            world.identities[B].verify(certificate, A, b"", signature, at_s=NOW_S)
