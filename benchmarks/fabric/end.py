"""The process at one end: `python -m benchmarks.fabric.end SPEC` (JSON, `benchmarks.link.load.Spec`)."""

from typing import Final

import uvloop

from benchmarks.fabric import hop_end, rivals
from benchmarks.link.load import End, play

ENDS: Final[dict[str, tuple[End, End]]] = {
    **dict.fromkeys(hop_end.VARIANTS, (hop_end.sender, hop_end.receiver)),
    "zenoh": (rivals.zenoh_sender, rivals.zenoh_receiver),
    "nats leaf": (rivals.nats_sender, rivals.nats_receiver),
}


def main() -> None:
    uvloop.install()
    play(ENDS)


if __name__ == "__main__":
    main()
