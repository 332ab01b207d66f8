"""A link profile as `tc netem` command lines, for people and for the lab.

What netem cannot say exactly, and what stands in for it: it loses packets before its rate stage, not after; a
blackout is 100 % loss, so what is in its queue still leaves; a reordered packet overtakes the others by skipping the
delay instead of being held back. Packets have their real headers there, so `overhead_bytes` is left out.
"""

import re
from typing import Final

from sern_core.vocabulary.errors import UsageError
from sern_sim.models import Jitter, LinkModel
from sern_sim.profiles import LinkProfile

DATAGRAM_BYTES: Final = 1228
"""A full SERN datagram with its IP and UDP headers, the size for which the queue limit is computed."""
_UNLIMITED: Final = "100gbit"
_DEVICE: Final = re.compile(r"[A-Za-z0-9_.-]{1,15}")


def netem_commands(profile: LinkProfile, dev: str, *, down: bool = False) -> list[str]:
    """Shell commands that shape what leaves `dev` like the up direction (`down`: the down direction) of `profile`.

    The first makes the link; for a scripted profile `sleep` and `tc qdisc change` follow, to the profile's
    `duration_s`. Undo with `netem_removal(dev)`. Raises UsageError for an impossible device name.
    """
    model = profile.down if down else profile.up
    commands = []
    last_s = 0.0
    for at_s, command in netem_timeline(model, dev, until_s=profile.duration_s):
        if at_s > last_s:
            commands.append(f"sleep {at_s - last_s:.6g}")
        commands.append(command)
        last_s = at_s
    return commands


def netem_timeline(model: LinkModel, dev: str, *, until_s: float) -> list[tuple[float, str]]:
    """(scenario time, command) for every change before `until_s`, beginning with the one that makes the link."""
    if not _DEVICE.fullmatch(dev):
        raise UsageError(f"{dev!r} is not a network device: give a name like eth0")
    timeline = [(0.0, f"tc qdisc replace dev {dev} root netem {netem_options(model, 0.0)}")]
    at_s = model.next_change_s(0.0)
    while at_s is not None and at_s < until_s:
        timeline.append((at_s, f"tc qdisc change dev {dev} root netem {netem_options(model, at_s)}"))
        at_s = model.next_change_s(at_s)
    return timeline


def netem_removal(dev: str) -> str:
    """The command that takes the shaping of `dev` away."""
    if not _DEVICE.fullmatch(dev):
        raise UsageError(f"{dev!r} is not a network device: give a name like eth0")
    return f"tc qdisc del dev {dev} root"


def netem_options(model: LinkModel, t_s: float) -> str:
    """netem's options for `model` at scenario time `t_s`, all of them, as `change` keeps what is not named."""
    options = [f"limit {model.queue_packets + model.packets_in_delay(DATAGRAM_BYTES)}"]
    if model.delay_s or model.jitter_s:
        delay = f"delay {_time(model.delay_s)}"
        if model.jitter_s:
            delay += f" {_time(model.jitter_s)}"
            if model.jitter is Jitter.NORMAL:
                delay += " distribution normal"
        options.append(delay)
    if model.blackout_at(t_s):
        options.append("loss 100%")
    elif model.burst_loss is not None:
        enter, leave, bad_loss, good_loss = model.burst_loss
        either = [1.0 - (1.0 - burst) * (1.0 - model.loss) for burst in (bad_loss, good_loss)]
        options.append("loss gemodel " + " ".join(_percent(value) for value in (enter, leave, *either)))
    elif model.loss or model.blackouts or model.flap:
        options.append(f"loss {_percent(model.loss)}")
    if model.duplicate:
        options.append(f"duplicate {_percent(model.duplicate)}")
    if model.reorder and model.delay_s:
        options.append(f"reorder {_percent(model.reorder)}")
    rate_bps = model.rate_bps_at(t_s)
    if rate_bps is not None:
        options.append(f"rate {_rate(rate_bps)}")
    elif model.rate_steps:
        options.append(f"rate {_UNLIMITED}")
    return " ".join(options)


def _time(time_s: float) -> str:
    return f"{1000.0 * time_s:.6g}ms"


def _percent(probability: float) -> str:
    return f"{100.0 * probability:.6g}%"


def _rate(rate_bps: float) -> str:
    rate = round(rate_bps)
    for unit, size in (("mbit", 1_000_000), ("kbit", 1_000)):
        if rate % size == 0:
            return f"{rate // size}{unit}"
    return f"{rate}bit"
