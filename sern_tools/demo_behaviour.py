"""How SERN behaved in a run of the demo: which lane carried it, and what its adaptation did, asked for all along."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

LANE_WORDS: Final = {"udp": "datagrams (UDP)", "zmq": "stream (TCP)"}


@dataclass(frozen=True, slots=True)
class Look:
    """What the robot said at script time `t_s`. Of the adaptation since the daemon began; None: it did not say."""

    t_s: float
    lane: str | None = None
    switches: int | None = None
    thinned: bool = False
    """Best-effort messages of some class are let in only in part."""
    summarised: bool = False
    """Some class is sent as summaries where its topics have any."""

    @classmethod
    def of(cls, t_s: float, link: Mapping[str, Any] | None, adaptation: Mapping[str, Any] | None) -> "Look":
        """Read it from an entry of /api/link, and of `links` in /api/mmcf."""
        lane = link["lane"] if link else None
        if not adaptation:
            return cls(t_s, lane)
        configuration = adaptation["configuration"]
        return cls(
            t_s,
            lane,
            adaptation["switches"],
            min(configuration["rates"].values()) < 1.0,
            any((configuration["summaries"] or {}).values()),
        )


@dataclass
class Behaviour:
    """The looks of one run, in order. Shares are of the time between looks; what a look says holds until the next."""

    looks: list[Look] = field(default_factory=list)

    def lane_shares(self) -> dict[str, float]:
        """Share of the time by lane."""
        times: Counter[str] = Counter()
        for look, after in pairwise(self.looks):
            if look.lane is not None:
                times[look.lane] += after.t_s - look.t_s  # type: ignore[assignment]
        total_s = sum(times.values())
        return {lane: span_s / total_s for lane, span_s in times.most_common()} if total_s else {}

    @property
    def lane_changes(self) -> int:
        lanes = [look.lane for look in self.looks if look.lane is not None]
        return sum(before != after for before, after in pairwise(lanes))

    @property
    def switches(self) -> int | None:
        """Times that the adaptation chose another configuration during the run; None: there was none."""
        counts = [look.switches for look in self.looks if look.switches is not None]
        return counts[-1] - counts[0] if counts else None

    def _share(self, name: str) -> float:
        spans = [(after.t_s - look.t_s, look) for look, after in pairwise(self.looks) if look.switches is not None]
        total_s = sum(span_s for span_s, _ in spans)
        return sum(span_s for span_s, look in spans if getattr(look, name)) / total_s if total_s else 0.0

    @property
    def thinned_share(self) -> float:
        return self._share("thinned")

    @property
    def summarised_share(self) -> float:
        return self._share("summarised")

    def rows(self, bulk_delivered_share: float) -> list[tuple[str, str]]:
        """What there is to say, in pairs of words; empty when nothing was seen. `bulk_delivered_share`: of the bulk
        messages that were offered."""
        if not self.looks:
            return []
        shares = self.lane_shares()
        lanes = ", ".join(f"{LANE_WORDS.get(lane, lane)} {share:.0%} of the time" for lane, share in shares.items())
        rows = [("lane", f"{lanes or 'not known'}; changed {_times(self.lane_changes)}")]
        if self.switches is not None:
            rows.append(
                (
                    "adaptation",
                    f"chose anew {_times(self.switches)}; thinned {self.thinned_share:.0%} and summarised "
                    f"{self.summarised_share:.0%} of the time",
                )
            )
        rows.append(("clouds", f"{bulk_delivered_share:.0%} of class bulk delivered"))
        return rows

    def as_row(self) -> dict[str, float]:
        """The same as figures. Where a lane is known at all, the share of the other one is there as well."""
        if not self.looks:
            return {}
        shares = self.lane_shares()
        found: dict[str, float] = {f"lane_{lane}_share": 0.0 for lane in LANE_WORDS} if shares else {}
        found |= {f"lane_{lane}_share": share for lane, share in shares.items()}
        found["lane_changes"] = self.lane_changes
        if self.switches is not None:
            found["adaptation_switches"] = self.switches
            found["adaptation_thinned_share"] = self.thinned_share
            found["adaptation_summarised_share"] = self.summarised_share
        return found


def _times(count: int) -> str:
    return {0: "never", 1: "once"}.get(count, f"{count} times")
