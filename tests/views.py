"""A link as one that nobody has used looks, for what reads views of links."""

from math import inf
from typing import Any

from sern_core.link.view import LinkView
from sern_core.path.lanes import LANE_ZMQ
from sern_core.vocabulary.types import ClientName

IDLE = LinkView(
    peer=ClientName("relay"),
    established=True,
    stalled=False,
    version=1,
    lane_id=LANE_ZMQ,
    lossless=True,
    fragment_bytes=1400,
    rate_bps=None,
    bound_bps=None,
    eased_s=-inf,
    window_bytes=1.0,
    inflight_bytes=0,
    rtprop_s=None,
    srtt_s=0.0,
    loss=0.0,
    waiting_s=None,
    stream_usable=True,
    datagrams_pass=False,
    express=False,
    wire_bytes=0,
    strays=0,
    clock_offset_s=0.0,
    clock_error_s=inf,
)


def link_view(**changes: Any) -> LinkView:
    """IDLE but for `changes`."""
    return IDLE._replace(**changes)
