"""How the time until clouds flow again is reckoned, and that the links come back as they were."""

import pytest

from benchmarks.link.figures import NEVER_S
from benchmarks.mmcf_recovery import END_S, FALLS_S, RETURNS_S, cases, recovered_s
from sern_sim.models import RateStep, Window


@pytest.mark.parametrize(
    ("times_s", "expected_s"),
    [
        ([30.0 + n for n in range(20)], 0.0),
        ([33.5 + n for n in range(20)], 2.0),
        ([30.0 + n for n in range(3)] + [37.0 + n for n in range(10)], 6.0),
        ([30.0 + 3 * n for n in range(6)], NEVER_S),
        ([], NEVER_S),
    ],
    ids=["at once", "later", "stopped between", "a third", "nothing"],
)
def test_clouds_flow_when_four_fifths_come_for_five_seconds(times_s: list[float], expected_s: float) -> None:
    assert recovered_s(times_s, 1.0, 30.0, 50.0) == expected_s


def test_clouds_that_flow_too_late_to_be_seen_for_five_seconds_never_did() -> None:
    assert recovered_s([47.0, 48.0, 49.0, 50.0, 51.0], 1.0, 30.0, 50.0) == NEVER_S


def test_every_link_comes_back_as_it_was_both_ways() -> None:
    found = cases()
    assert len({case.name for case in found}) == len(found)
    for case in found:
        up = case.profile().up
        assert up == case.profile().down and up.streaming is case.stream and up.rate_bps == case.link.rate_bps
        if case.thin_bps is None:
            assert up.blackouts == (Window(FALLS_S, RETURNS_S),) and up.rate_steps == ()
        else:
            assert up.rate_steps == (RateStep(FALLS_S, case.thin_bps), RateStep(RETURNS_S, case.link.rate_bps or 0.0))
        assert case.cloud_hz * (END_S - RETURNS_S) > 20


def test_what_is_promised_is_by_round_trip() -> None:
    limits = {case.name: case.limit_s for case in cases()}
    assert limits["lte, 0.3 Mbit/s"] == 5.0
    assert limits["4 Mbit/s 200 ms, 0.3 Mbit/s, stream"] == 10.0
    assert limits["satcom, gone"] is None
