"""The tables of bridge and endpoint, compared and mended: what should be open there, and what is."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sern_client.bridge import Bridge
from sern_client.endpoints.base import Difference, Held
from sern_client.link_state import LinkState

if TYPE_CHECKING:
    from sern_client.scene.node import SceneNode


class Tables:
    """`link_state` and `scene` have topics of their own at the endpoint."""

    def __init__(self, bridge: Bridge, link_state: LinkState | None = None, scene: "SceneNode | None" = None) -> None:
        self._scene = scene
        self._bridge = bridge
        self._link_state = link_state

    def validate(self) -> list[Difference]:
        """Compare our tables with the core's and the endpoint's: what is not as it should be. Something under way may
        show for a moment."""
        inbound, outbound = self._bridge.inbound, self._bridge.outbound
        found = inbound.validate() + outbound.validate()
        publishers = inbound.held + outbound.stored.held
        if self._link_state is not None:
            publishers += self._link_state.held
        subscriptions = outbound.held
        if self._scene is not None:
            publishers += self._scene.held.publishers
            subscriptions += self._scene.held.subscriptions
        return found + self._bridge.site.endpoint.validate(Held(publishers, subscriptions))

    def repair(self, differences: Sequence[Difference]) -> None:
        """Open anew at the endpoint what is not open there as it should be."""
        publishers = {difference.name for difference in differences if difference.kind == "publisher"}
        if self._link_state is not None:
            self._link_state.repair(publishers)
        self._bridge.inbound.repair(publishers)
        self._bridge.outbound.stored.repair(publishers)
        self._bridge.outbound.repair({each.name for each in differences if each.kind == "subscription"})
