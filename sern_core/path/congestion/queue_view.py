"""What one epoch shows of the queue and of jitter, and how long a queue is wanted."""

from collections import deque
from math import inf
from typing import Final

from sern_core.path.congestion.link_rate import LinkRate
from sern_core.path.congestion.params import HybridParams

KNOWN_EPOCHS: Final = 8
"""From then on it is known whether a path has jitter."""


class QueueView:
    """The queue of the last epoch, and the one that is wanted there."""

    __slots__ = (
        "_learned_epochs",
        "_params",
        "_spreads",
        "_steered_epochs",
        "calm",
        "gentle",
        "high_s",
        "jitter_s",
        "jittery",
        "least_spread_s",
        "most_s",
        "queue_s",
        "serialise_s",
        "target_s",
    )

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self._spreads: deque[float] = deque(maxlen=16)
        self._steered_epochs = 0
        self._learned_epochs = KNOWN_EPOCHS  # since it was known that there is jitter
        self.queue_s = 0.0
        """20th percentile of the epoch."""
        self.most_s = 0.0
        """80th."""
        self.serialise_s = 0.0
        """What the largest packet takes."""
        self.jitter_s = 0.0
        self.least_spread_s = 0.0
        """The least spread of the delay in an epoch, but for chance: what jitter makes of it, whoever else sends."""
        self.target_s = 0.0
        self.high_s = inf
        """A longer queue is to go at once."""
        self.calm = False
        """Whether there is no jitter, and a packet takes little."""
        self.gentle = False
        """Whether it is calm, and a packet takes long enough to be steered for."""
        self.jittery = False
        """Whether the spread is more than packets in each other's way make of it."""

    def close_epoch(
        self,
        queues: list[float],
        rtt_s: float,
        rate: LinkRate,
        fragment: float,
        *,
        packet_s: float,
        usual: bool,
        limited: bool,
        steered: bool,
    ) -> None:
        """See the queues of an epoch, sorted. `packet_s`: so closely the largest packets followed each other, most of
        the time: the link does not take longer for one, however little we have sent. `usual`: the largest packet is of
        the size that was planned for. `limited`: there was more to send; `steered`: the queue was kept short. With
        neither, what spreads the queue may be what was sent at once now and again."""
        params = self._params
        count = len(queues)
        fifth_s, self.most_s = queues[count // 5], queues[count * 4 // 5]
        spread_s = self.most_s - fifth_s
        self.queue_s = max(0.0, fifth_s)
        if steered or limited:
            weight = 1.0 / (2 + min(self._learned_epochs, KNOWN_EPOCHS))
            self.jitter_s += weight * (min(spread_s, 0.020 + 0.2 * rtt_s) - self.jitter_s)
        if steered:
            self._steered_epochs += 1
            self._learned_epochs += 1
        # Of the link, not of our share of it: by the greatest rate seen lately.
        serialise_s = self.serialise_s = fragment / rate.peak if rate.peak else 0.0
        self._spreads.append(spread_s)
        own_s = fragment / rate.value if rate.value else 0.0
        packet_s = min(packet_s, serialise_s)
        noise_s = params.noise * max(0.0, self.jitter_s - packet_s)
        # A slower flow wants a longer queue than a faster one, so that their shares meet.
        self.calm = noise_s <= params.calm_noise_s and serialise_s <= params.calm_packet_s
        self.least_spread_s = sorted(self._spreads)[len(self._spreads) // 8]
        self.jittery = self.least_spread_s > (params.calm_noise_s if packet_s <= params.calm_packet_s else packet_s)
        # Fragments of a stream grow with its rate, and TCP cuts them anew: what they take is not known so well.
        self.gentle = self.calm and serialise_s >= params.gentle_packet_s and usual
        packets = params.gentle_packets if self.gentle else params.calm_packets if self.calm else params.target_packets
        packets += params.fast_packets * max(0.0, 1 - serialise_s / params.fast_s)
        turns_s = params.turns_s * max(0.0, 1 - params.turns_rate / rate.peak) if rate.peak else 0.0
        self.target_s = params.target_s + packets * min(own_s, 4 * serialise_s) + noise_s + turns_s
        self.high_s = max(0.010, 0.1 * rtt_s) + serialise_s + 1.5 * noise_s

    def learn(self) -> None:
        """There is jitter, of which too little is known."""
        self._learned_epochs = 0

    @property
    def may_jitter(self) -> bool:
        """Whether packets may come unevenly on an empty path: they do, or too little was seen of it."""
        return self.jittery or self._steered_epochs < KNOWN_EPOCHS

    @property
    def jitters(self) -> bool:
        """Whether there is jitter for all that is known: start-up has met it just now, or it is seen since."""
        return self.jittery or self._learned_epochs < KNOWN_EPOCHS

    @property
    def long(self) -> bool:
        """Whether the queue is to go at once."""
        return self.queue_s > self.high_s

    @property
    def empty(self) -> bool:
        """Whether hardly anything queues."""
        return self.queue_s < 0.25 * self.target_s

    @property
    def clear_s(self) -> float:
        """Up to this 80th percentile hardly a packet met another one."""
        return min(self._spreads) + self._params.clear_packets * self.serialise_s
