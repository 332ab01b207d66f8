"""How the ages over 64 kbit/s are reckoned."""

from benchmarks.thin_link import ROWS, ages
from tests.thin_link import COUNTED_S, RATES_HZ


def test_ages_are_of_what_arrived_and_offered_is_told_beside_it() -> None:
    found_s = [0.1 + 0.01 * number for number in range(100)]
    row = ages(found_s, 2.0)
    assert (row["offered_count"], row["arrived_count"]) == (2 * COUNTED_S, 100)
    assert (row["age_p50_s"], row["age_p99_s"], row["age_most_s"]) == (found_s[50], found_s[99], found_s[99])
    assert ages([], 1.0) == {"offered_count": COUNTED_S, "arrived_count": 0}, "what never came has no age"


def test_every_topic_has_a_row_that_says_what_is_offered() -> None:
    assert set(ROWS.values()) == set(RATES_HZ)
    assert "clouds, 20,000 B, 2 Hz" in ROWS
