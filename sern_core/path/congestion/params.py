"""The numbers that the window from delay and rate goes by."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class HybridParams:
    """Times in seconds, sizes in bytes, rates in bytes a second; packets are times of what a packet takes."""

    # Epochs and what is measured in them
    min_epoch_s: float = 0.040
    min_epoch_samples: int = 4
    jittery_epoch_samples: int = 16
    """Fewer say little of the queue where jitter moves each of them..."""
    jittery_epochs: float = 4.0
    """... but an epoch lasts at most so many times as long for it."""
    base_window_s: float = 10.0
    rate_window_s: float = 1.2
    min_rate_span_s: float = 0.120
    peak_decay: float = 0.02
    """Share of the peak rate that is forgotten each second."""
    noise: float = 1.0
    """The least of many epochs lies so many times their spread below the usual one, though no queue ever was."""
    lost_by_chance: float = 3.0
    """Standard deviations of what is lost in an epoch, where packets are lost one by one."""

    # The queue that is wanted
    target_s: float = 0.0002
    target_packets: float = 0.32
    fast_packets: float = 2.5
    fast_s: float = 0.002
    """Where a packet takes less than this, up to so many more: they cost little, and flows share more fairly."""
    turns_s: float = 0.002
    turns_rate: float = 50e6
    """What queues for a moment on a faster path waits for a processor, as processes take turns."""
    calm_packets: float = 0.3
    """Replaces `target_packets` where there is no jitter and a packet takes little: with jitter the rate would drift
    down unseen, and an epoch has too few long packets. So does `calm_pacing` `pacing_gain`."""
    calm_noise_s: float = 0.0005
    calm_packet_s: float = 0.003
    gentle_packet_s: float = 0.0015
    """The pace steers, not the window, where a packet takes longer: one more in flight is a step of the queue there."""
    gentle_packets: float = 0.4

    # The window
    initial_window_bytes: int = 12_600
    min_window_fragments: float = 1.5
    """The least window; the hop commits one fragment beyond it."""
    max_window_bytes: int = 64 * 2**20
    gain: float = 0.35
    patient_epochs: int = 2
    """The effect of a step is seen two epochs later; only then may the next one be larger."""
    clear_packets: float = 1.0
    """The path counts as empty when four packets of five met at most about one other."""
    first_growth: float = 0.02
    max_growth: float = 0.25
    room_gain: float = 1.25
    held_spreads: float = 1.5
    """At most so many spreads of the delay are taken for what jitter holds back: it may be a queue after all."""
    segmented_spreads: float = 3.0
    """The same bound for packets of many segments, each of which jitter may hold."""
    cut: float = 0.95
    idle_s: float = 2.0
    """What was not used for so long is halved, for the link may have changed; start-up brings it back."""

    # Start-up
    startup_gain: float = 4.0
    startup_jittery_gain: float = 2.0
    """Where packets come unevenly."""
    startup_pacing: float = 4.0
    startup_aim: float = 0.9
    startup_share: float = 0.75
    """A round ends when this share of its window has been acknowledged."""
    startup_longer: float = 0.4
    """A window is full if packets took longer by this share of what they took in the quickest round..."""
    startup_far: float = 2.0
    """... and far more than full if they took so many times as long."""
    startup_rounds: int = 2
    """Rounds in a row that show that it is full, where packets come unevenly."""

    # Pacing
    pacing_gain: float = 1.03
    calm_pacing: float = 0.985
    calm_share: float = 0.05
    """How much faster the pace is of a sender that has none of the link, so that shares meet."""
    burst_pacing: float = 1.25
    """Where only bursts show what the link carries: at a slower pace they would show the pace."""
    drain_pacing: float = 0.98
    compete_pacing: float = 1.2
    gentle_pacing: tuple[float, ...] = (1.01, 1.01, 1.01, 1.02, 1.03, 1.05, 1.09, 1.17, 1.3, 1.5)
    """The pace over the capacity, epoch by epoch, while the path looks empty and the pace steers."""

    # Making way
    max_drain_s: float = 1.0
    drain_interval_s: float = 5.0
    drain_rtts: float = 20.0
    """On long paths draining is rarer: a round trip at 0.6 of the product costs 2 % of twenty."""
    drain_gain: float = 0.6

    # A link that got slower
    emergency_cut: float = 0.9
    emergency_s: float = 0.050
    slower: float = 0.8
    """The link got slower when less than this share of the known rate passes a queue that stays."""
    went: float = 0.25
    """A queue that came down to this share of the longest one since the link got slower, as we made way, was ours..."""
    went_rtts: float = 10
    went_slower: float = 0.1
    """... if it was `went_rtts` round trips long and the rate fell to this share: a rival leaves more, and its queue is
    short for a moment whenever it looks at the empty path."""

    # Somebody else
    stuck_epochs: int = 4
    stuck_wait_s: float = 1.0
    flat_s: float = 0.003
    loss_memory_s: float = 3.0
    rival_memory_s: float = 30.0
    gone_times: int = 2
    """A rival whose queue went so often in that time, each time that we made way and to the last packet, is none."""
    compete_max_s: float = 30.0
    compete_queue_s: float = 1.0
    """A stream never loses a packet: its queue would grow without end."""

    quicker_epochs: int = 8

    # A link whose rate swings
    variable_times: float = 1.5
    """A rate so many times another one is another one."""
    variable_turns: int = 3
    variable_memory_s: float = 20.0
    """The link swings when its rate turned so often in this time..."""
    variable_fade_s: float = 1.0
    """... or down and up within this one."""
    variable_span_s: float = 0.060
    """Time over which a link that is full is measured for it; longer with jitter."""
    variable_queue_s: float | None = 0.01
    """The queue that is kept while it does; None: it is treated as any other link."""
    variable_rate_s: float = 0.050
    """Time over which what arrives is what the link carries now."""
    variable_growth: float = 0.6
    """The window grows by this share of the bytes that are acknowledged, while nothing queues."""
    variable_ahead: float = 1.5
    variable_ahead_packets: float = 6.0
    """The window is at most so many times what was carried of late, and so many packets."""
    variable_pacing: float = 1.25
    variable_patience_s: float = 1.5
    variable_long: float = 2.0
    variable_stays: float = 0.7
    """A queue so many times the wanted one, in so large a share of the last epochs, about `variable_patience_s`, may be
    somebody else's: the window makes way until it is known."""


DEFAULT_HYBRID = HybridParams()
