"""Views: of a link that nobody has used, for what reads views of links; of the peers that a client knows."""

from math import inf
from typing import Any

from sern_core.link.view import LinkView
from sern_core.path.lanes import LANE_ZMQ
from sern_core.site.peers import PeerStatus, PeerView
from sern_core.vocabulary.types import ClientName
from tests.world import SimClient

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
    priority_lane=False,
    wire_bytes=0,
    strays=0,
    clock_offset_s=0.0,
    clock_error_s=inf,
)


def link_view(**changes: Any) -> LinkView:
    """IDLE but for `changes`."""
    return IDLE._replace(**changes)


def peers(client: SimClient) -> dict[str, PeerView]:
    return {view.name: view for view in client.core.look_at_peers(now=client.now)}


def statuses(client: SimClient) -> dict[str, PeerStatus]:
    return {name: view.status for name, view in peers(client).items()}
