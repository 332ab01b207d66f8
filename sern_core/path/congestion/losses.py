"""What is lost on the way, in an epoch and usually."""

from math import inf

from sern_core.path.congestion.params import HybridParams


class Losses:
    """Bytes lost and `acked_bytes` in an epoch; `usual` is the smoothed share that is lost."""

    __slots__ = ("_lost_bytes", "_params", "acked_bytes", "at_s", "usual")

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self.usual = 0.0
        self.at_s = -inf
        """When something was lost last."""
        self.next_epoch()

    def next_epoch(self) -> None:
        self._lost_bytes = self.acked_bytes = 0

    def lost(self, now: float, nbytes: int) -> None:
        self._lost_bytes += nbytes
        self.at_s = now

    @property
    def share(self) -> float:
        """What of the epoch was lost."""
        return self._lost_bytes / max(1, self._lost_bytes + self.acked_bytes)

    def learn(self, share: float) -> None:
        """Take what was lost for usual."""
        self.usual += 0.05 * (min(share, 0.2) - self.usual)

    def unusual(self, share: float, fragment: float) -> float:
        """What was lost in the epoch beyond what may be by chance where as much is lost as usual."""
        count = (self._lost_bytes + self.acked_bytes) / fragment
        usual = self.usual
        chance = self._params.lost_by_chance * (usual * count) ** 0.5 + 2.0
        return share - usual if count * (share - usual) > chance else 0.0
