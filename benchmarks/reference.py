"""What CPU limits are multiples of: what a bare forwarder takes for one datagram, on this machine and in this run.

Machines differ threefold, so microseconds and shares of a core say nothing by themselves. Every relay must at least
receive a datagram, open it, seal it and send it; `benchmarks.link.forwarder` does that and nothing else.
"""

import socket
import struct
import time
from contextlib import ExitStack
from statistics import median
from typing import Final

from benchmarks.common import Report
from benchmarks.link.forwarder import Forwarder, Hops
from sern_core.vocabulary.errors import SernError
from sern_runtime.seal import ROOM_BYTES, Sealer, Side

BATCH: Final = 32
"""Datagrams that wait in the socket at a time: they fit into its buffer."""
BATCHES: Final = 60
PATIENCE_S: Final = 5
HOST: Final = "127.0.0.1"


def forwarding_us(batches: int = BATCHES) -> float:
    """CPU microseconds of the bare forwarder for a datagram of the full size over loopback: the median over batches.

    Raises SernError when a datagram does not come through.
    """
    with ExitStack() as stack:
        source, inlet, outlet, sink = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(4)
        )
        for bound in (inlet, sink):
            bound.bind((HOST, 0))
            # The kernel's own timeout: that of Python would ask twice for each datagram.
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", PATIENCE_S, 0))
        source.connect(inlet.getsockname())
        outlet.connect(sink.getsockname())
        hops = Hops.draw()
        forwarder, sealer = Forwarder(hops, inlet, outlet), Sealer(hops.first, Side.CLIENT)
        body = bytes(ROOM_BYTES)
        spent_us = []
        try:
            for _ in range(batches):
                for _ in range(BATCH):
                    source.send(sealer.seal(body))
                begun_s = time.process_time()  # not the clock: other load on this machine is no cost of ours
                for _ in range(BATCH):
                    forwarder.step()
                spent_us.append(1e6 * (time.process_time() - begun_s) / BATCH)
                for _ in range(BATCH):
                    sink.recv(2 * ROOM_BYTES)
        except BlockingIOError as error:
            raise SernError("the bare forwarder lost a datagram over loopback") from error
    return median(spent_us)


def reach_forwarding(report: Report, name: str, cost_us: float, limit: float) -> None:
    """Hold a CPU cost against `limit` times what forwarding one datagram takes, measured now, and note what that is."""
    bare_us = forwarding_us()
    report.note(f"{name}: {cost_us:.3g} µs of CPU; the bare forwarder takes {bare_us:.3g} µs for a datagram")
    report.reach(f"{name}, by that of forwarding one datagram", cost_us / bare_us, limit)
