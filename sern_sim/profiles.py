"""Named link profiles: the two directions of a hop with a script of what happens to them.

Plain data; `sern_runtime.profiles` reads `sern_runtime/profiles.yaml` into it. Users of a profile are the
virtual-time network (`Network.join(..., profile.up, profile.down)`), the shaping proxy and the lab.
"""

from dataclasses import dataclass, replace
from typing import Final

from sern_core.vocabulary.errors import UsageError
from sern_sim.models import LinkModel

DEFAULT_DURATION_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class LinkProfile:
    """A link between a client (robot or site) and its relay.

    `up` is client to relay, `down` relay to client. `duration_s` is how long a demonstration or a test of the
    profile runs so that everything in its script has happened and been recovered from.
    """

    name: str
    description: str
    up: LinkModel
    down: LinkModel
    duration_s: float = DEFAULT_DURATION_S

    def __post_init__(self) -> None:
        if self.duration_s <= 0.0:
            raise UsageError(f"duration_s is {self.duration_s}: give a time above 0 s")

    @property
    def symmetric(self) -> bool:
        return self.up == self.down

    @property
    def delay_s(self) -> float:
        """One-way delay of the up direction, without jitter."""
        return self.up.delay_s

    @property
    def rtt_s(self) -> float:
        """Round-trip time of an idle link, without jitter."""
        return self.up.delay_s + self.down.delay_s

    @property
    def queue_packets(self) -> int:
        """Packets that the up direction's bottleneck holds."""
        return self.up.queue_packets

    def rate_bps_at(self, t_s: float) -> float | None:
        """Rate of the up direction at scenario time `t_s`; None: unlimited. For down: `profile.down.rate_bps_at`."""
        return self.up.rate_bps_at(t_s)

    def blackout_at(self, t_s: float) -> bool:
        """True when either direction is gone at scenario time `t_s`."""
        return self.up.blackout_at(t_s) or self.down.blackout_at(t_s)

    def next_change_s(self, t_s: float) -> float | None:
        """When a rate or the blackout state changes next, strictly after `t_s`; None: never again."""
        changes = (self.up.next_change_s(t_s), self.down.next_change_s(t_s))
        return min((change_s for change_s in changes if change_s is not None), default=None)

    def as_stream(self, *, disconnect_after_s: float | None = None, reconnect_s: float | None = None) -> "LinkProfile":
        """The same path as a TCP-like connection sees it, both directions."""
        return replace(
            self,
            up=self.up.as_stream(disconnect_after_s=disconnect_after_s, reconnect_s=reconnect_s),
            down=self.down.as_stream(disconnect_after_s=disconnect_after_s, reconnect_s=reconnect_s),
        )
