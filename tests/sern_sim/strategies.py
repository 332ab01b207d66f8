"""Hypothesis strategies for links: everything a link can do, in sizes that a short run meets."""

from itertools import accumulate

from hypothesis import strategies as st

from sern_sim.models import BurstLoss, Flap, Jitter, LinkMode, LinkModel, RateStep, Window


def _probabilities(highest: float) -> st.SearchStrategy[float]:
    return st.one_of(st.just(0.0), st.floats(0.0, highest))


def times(highest_s: float) -> st.SearchStrategy[float]:
    """Whole milliseconds, so that failing examples read well."""
    return st.integers(0, round(1000 * highest_s)).map(lambda ms: ms / 1000)


def rates() -> st.SearchStrategy[float | None]:
    return st.one_of(st.none(), st.sampled_from([64e3, 256e3, 1e6, 4e6, 8e6]), st.integers(20_000, 10_000_000))


@st.composite
def rate_steps(draw: st.DrawFn, run_s: float) -> tuple[RateStep, ...]:
    at_s = sorted(draw(st.sets(times(run_s), max_size=4)))
    return tuple(RateStep(step_s, draw(rates())) for step_s in at_s)


@st.composite
def windows(draw: st.DrawFn, run_s: float) -> tuple[Window, ...]:
    gaps_ms = draw(st.lists(st.integers(1, round(1000 * run_s / 2)), max_size=6))
    edges = [ms / 1000 for ms in accumulate(gaps_ms)]
    return tuple(Window(start_s, end_s) for start_s, end_s in zip(edges[::2], edges[1::2], strict=False))


@st.composite
def link_models(
    draw: st.DrawFn, *, mode: LinkMode = LinkMode.DATAGRAM, run_s: float = 10.0, highest_loss: float = 0.3
) -> LinkModel:
    """Any link whose script plays within about `run_s` seconds."""
    flap = draw(st.one_of(st.none(), st.builds(Flap, *([times(run_s / 4).map(lambda s: s + 0.05)] * 2), times(run_s))))
    return LinkModel(
        rate_bps=draw(rates()),
        delay_s=draw(times(0.5)),
        jitter_s=draw(st.one_of(st.just(0.0), times(0.1))),
        jitter=draw(st.sampled_from(Jitter)),
        loss=draw(_probabilities(highest_loss)),
        burst_loss=draw(
            st.one_of(
                st.none(),
                st.builds(BurstLoss, st.floats(0, 0.1), st.floats(0.2, 1), st.floats(0, 0.9), st.floats(0, 0.05)),
            )
        ),
        reorder=draw(_probabilities(0.2)),
        reorder_delay_s=draw(times(0.2)),
        duplicate=draw(_probabilities(0.2)),
        queue_packets=draw(st.integers(1, 200)),
        overhead_bytes=draw(st.sampled_from([0, 28, 60])),
        rate_steps=draw(rate_steps(run_s)),
        blackouts=() if flap else draw(windows(run_s)),
        flap=flap,
        mode=mode,
        disconnect_after_s=draw(times(run_s / 4)),
        reconnect_s=draw(times(1.0)),
    )
