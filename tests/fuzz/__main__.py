"""`python -m tests.fuzz`: tries made-up input on what reads bytes of others, for as long as is asked.

    wire       frames, control messages and announcements, to their codec
    handshake  what a relay is sent before there is a session
    datagram   what a relay and a client are sent in a session, several datagrams at a time
    sealed     UDP datagrams, to the part that opens them, as they come and sealed by somebody who has the key
    config     files of relay, client and keys

A fault ends it with 1, and its input stays in the corpus as `failure-...`; `--replay FILE` tries it again.
"""

import argparse
import re
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from sern_core.wire import framing
from sern_core.wire.announce import decode_announcement
from sern_runtime.seal import Cipher, Opener, Sealer, SessionParameters, Side
from tests.fuzz.fuzzer import Corpus, FoundError, Fuzzer
from tests.fuzz.fuzzer import Target as Ready
from tests.fuzz.test_fuzz_config import checked
from tests.fuzz.test_fuzz_wire import BAD, GOOD, Duet, assert_in_order_after, tried
from tests.make_vectors import decode
from tests.world import World

ROOT: Final = Path(__file__).parents[2]
VECTORS: Final = [data for _layer, data in (*GOOD.values(), *BAD.values())]
LENGTH_BYTES: Final = 2


class Target(NamedTuple):
    """What is tried, as `fuzzer.Target` says."""

    ready: Ready
    seeds: Callable[[], Iterable[bytes]]
    watched: tuple[str, ...]
    """Folders and files whose lines count."""


def wire(data: bytes) -> None:
    for layer in ("datagram", "control"):
        tried(lambda layer=layer: decode(layer, data))  # type: ignore[misc]
    said: list[framing.Envelope] = []
    if tried(lambda: said.append(framing.decode_control(data)[0])):
        tried(lambda: decode_announcement(said[0]))


def handshake(data: bytes) -> Callable[[], object]:
    world = World()
    client = world.client("robot")
    port = world.relay.port(client.name)
    port.connected(now=0.0)

    def said() -> None:
        if tried(lambda: port.receive(data, now=0.0)):
            while port.next_datagram(now=0.0) is not None:
                pass
        world.relay.hub.validate()

    return said


def split(data: bytes) -> list[bytes]:
    """Datagrams behind their lengths."""
    found = []
    while data:
        length = int.from_bytes(data[:LENGTH_BYTES], "big")
        found.append(data[LENGTH_BYTES : LENGTH_BYTES + length])
        data = data[LENGTH_BYTES + length :]
    return found[:20]


def joined(datagrams: Iterable[bytes]) -> bytes:
    return b"".join(len(datagram).to_bytes(LENGTH_BYTES, "big") + datagram for datagram in datagrams)


def datagram(data: bytes) -> Callable[[], object]:
    return partial(assert_in_order_after, split(data[1:]), to_relay=data[:1] < b"\x80", duet=Duet())


def datagram_seeds() -> Iterable[bytes]:
    said = Duet().said
    for who, first in (("robot", b"\0"), ("relay", b"\x80")):
        for start in range(0, len(said[who]), 3):
            yield first + joined(said[who][start : start + 3])


SESSION: Final = SessionParameters(7, bytes(32), Cipher.CHACHA20_POLY1305, 5555)


def sealed(data: bytes) -> None:
    opener = Opener(SESSION, Side.CLIENT)
    packets = split(data)
    opened = [packet for packet in packets if opener.open(packet) is not None]
    assert len(set(opened)) == len(opened), "one was taken twice"
    assert len(opened) + sum(opener.refused.values()) == len(packets)


def sealed_seeds() -> Iterable[bytes]:
    sealer = Sealer(SESSION, Side.CLIENT)
    said = [sealer.seal(bytes(number)) for number in range(8)]
    return (joined(said), joined([*said, *said]), joined(reversed(said)))


def examples() -> Iterable[bytes]:
    """Sections of the example files: the whole of one takes long to read."""
    for path in sorted((ROOT / "deploy" / "examples").glob("*.yaml")):
        sections = re.split(r"\n(?=\w)", re.sub(r"(?m)\s*#.*$", "", path.read_text()))
        yield from (section.encode() for section in sections if section.strip())


CORE: Final = str(ROOT / "sern_core")
CONFIG: Final = str(ROOT / "sern_runtime" / "config")
TARGETS: Final = {
    "wire": Target(lambda data: partial(wire, data), lambda: VECTORS, (CORE,)),
    "handshake": Target(handshake, lambda: VECTORS, (CORE,)),
    "datagram": Target(datagram, datagram_seeds, (CORE,)),
    "sealed": Target(lambda data: partial(sealed, data), sealed_seeds, (str(ROOT / "sern_runtime" / "seal.py"),)),
    "config": Target(lambda data: partial(checked, data), examples, (CONFIG,)),
}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("targets", nargs="*", choices=[*TARGETS, []], help="these alone; else all of them")
    parser.add_argument("--seconds", type=float, default=60.0, help="for how long each is tried (60)")
    parser.add_argument(
        "--corpus", type=Path, default=ROOT / "build" / "fuzz", help="where inputs are kept (build/fuzz)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--replay", type=Path, help="try this one file on the targets")
    options = parser.parse_args(arguments)
    for name in options.targets or TARGETS:
        target = TARGETS[name]
        if options.replay is not None:
            target.ready(options.replay.read_bytes())()
            continue
        corpus = Corpus(options.corpus / name)
        try:
            fuzzer = Fuzzer(target.ready, target.seeds(), corpus, watched=target.watched, seed=options.seed)
            fuzzer.run(seconds=options.seconds)
        except FoundError as error:
            print(f"{name}: {error}", file=sys.stderr)
            return 1
        print(
            f"{name}: {fuzzer.tried} inputs, {fuzzer.lines} lines run, {len(corpus.inputs)} kept in {corpus.directory}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
