"""The thinnest link that SERN is said to be for, 64 kbit/s, in virtual time: what is driven by goes on."""

import pytest

from tests.thin_link import (
    CLOUD,
    COMMAND,
    COUNTED_S,
    DATAGRAM_S,
    DELAY_S,
    POSE,
    RATES_HZ,
    STATUS,
    play,
)


@pytest.mark.parametrize("lossless", [True, False])
def test_over_64_kbit_per_s_control_and_state_arrive_in_time_beside_clouds(lossless: bool) -> None:
    run = play(lossless=lossless)
    poses, commands = run.ages_s(POSE), run.ages_s(COMMAND)
    assert len(poses) >= 0.98 * RATES_HZ[POSE] * COUNTED_S and len(commands) >= 0.98 * RATES_HZ[COMMAND] * COUNTED_S
    assert poses[0] > DELAY_S, "nothing is faster than the link"
    assert poses[int(0.99 * len(poses))] < DELAY_S + 3 * DATAGRAM_S
    assert commands[int(0.99 * len(commands))] < DELAY_S + DATAGRAM_S

    assert run.site.seqs(STATUS) == list(range(1, len(run.site.on(STATUS)) + 1))
    states = run.ages_s(STATUS)
    # Which is lost twice is chance: one of a hundred may be, and then comes after two waits for an acknowledgement.
    late_s = states[-1] if lossless else states[int(0.95 * len(states))]
    assert len(states) >= COUNTED_S - 1 and late_s < DELAY_S + 6 * DATAGRAM_S
    assert len(run.ages_s(CLOUD)) >= 10, "clouds are not starved"
    run.world.validate()
