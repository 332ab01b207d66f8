"""The process at one end: `python -m benchmarks.fabric.end SPEC` (JSON, `benchmarks.link.load.Spec`)."""

import json
import sys
from collections.abc import Callable
from typing import Any, Final

import uvloop

from benchmarks.fabric import hop_end, rivals
from benchmarks.link.load import Load, Log, Orders, Spec

End = Callable[[Spec, Load, Orders, Log], dict[str, Any]]
ENDS: Final[dict[str, tuple[End, End]]] = {
    **dict.fromkeys(hop_end.VARIANTS, (hop_end.sender, hop_end.receiver)),
    "zenoh": (rivals.zenoh_sender, rivals.zenoh_receiver),
    "nats leaf": (rivals.nats_sender, rivals.nats_receiver),
}


def main() -> None:
    uvloop.install()
    spec = Spec(**json.loads(sys.argv[1]))
    send, receive = ENDS[spec.system]
    log = Log()
    seen = (send if spec.sends else receive)(spec, Load(**spec.load), Orders(), log)
    log.save(spec.path / f"{spec.role}.npy")
    (spec.path / f"{spec.role}.json").write_text(json.dumps(seen))


if __name__ == "__main__":
    main()
