"""How recorded links are read and played."""

import argparse
from pathlib import Path

import pytest

from benchmarks import cellular
from benchmarks.cellular import bench, play_core, play_informed
from benchmarks.common import Report
from benchmarks.flows import OVERHEAD_BYTES
from benchmarks.recorded_links import SLOT_PACKET_BYTES, read, recorded
from sern_core.path.congestion.params import DEFAULT_HYBRID
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.params import WindowParams

EVEN = [4] * 500
"""10 s of a link of 2.4 Mbit/s."""
FADING = ([20] * 10 + [2] * 10) * 25


def test_what_is_measured_is_the_default() -> None:
    assert cellular.QUEUE_S == WindowParams().variable_rate_queue_s == DEFAULT_HYBRID.variable_queue_s


def test_a_recording_is_packets_in_each_slot(tmp_path: Path) -> None:
    path = tmp_path / "link.csv"
    path.write_text("# packets\n3\n0\n\n7\n")
    assert read(path) == [3, 0, 7]
    path.write_text("3\nseven\n")
    with pytest.raises(ConfigError, match=r"is no recording of a link: invalid literal.*seven"):
        read(path)
    with pytest.raises(ConfigError, match="No such file"):
        read(tmp_path / "none.csv")


def test_the_link_carries_what_was_recorded() -> None:
    model, duration_s = recorded(FADING, None)
    assert duration_s == 10.0
    assert model.capacity_bits(0.0, duration_s) == pytest.approx(8 * SLOT_PACKET_BYTES * sum(FADING))
    assert model.rate_bps_at(0.1) == pytest.approx(20 * SLOT_PACKET_BYTES * 8 / 0.02)
    assert model.rate_bps_at(0.3) == pytest.approx(2 * SLOT_PACKET_BYTES * 8 / 0.02)
    assert recorded(FADING, 3.0)[1] == pytest.approx(3.0)


def test_what_is_sent_in_a_gap_waits_for_its_end() -> None:
    model, duration_s = recorded([4] * 150 + [0] * 50 + [4] * 300, None)
    played = play_core(model, duration_s, offered=0.0)
    assert 250 < len(played.ages_s) < 300, "some of the gap were replaced by newer ones, of 6 s that count"
    assert played.ages_s[0] < 0.03 and played.ages_s[-1] > 0.9


def test_bulk_fills_a_link_and_poses_alone_do_not() -> None:
    model, duration_s = recorded(EVEN, None)
    alone, beside = (play_core(model, duration_s, offered=offered) for offered in (0.0, 4.0))
    pose_share = 50 * 8 * (100 + 80 + OVERHEAD_BYTES) / model.rate_bps_at(1.0)  # type: ignore[operator]
    assert alone.used == pytest.approx(pose_share, rel=0.3) and alone.delivered == 0
    assert beside.used > 0.9 and 0.6 < beside.delivered < beside.used
    assert 1.0 < beside.ages_s[-1] / alone.ages_s[-1] < 3.0


def test_who_is_informed_a_round_trip_late_waits_for_fades_all_the_same() -> None:
    even, fading = (play_informed(slots, 10.0, 0.01) for slots in (EVEN, FADING))
    assert even.used > 0.95 and fading.used > 0.85
    assert even.ages_s[-1] == pytest.approx(0.035, abs=0.003)
    assert fading.ages_s[-1] > 0.2


def test_a_folder_of_recordings_becomes_rows_and_figures(tmp_path: Path) -> None:
    (tmp_path / "some_lte_up.csv").write_text("\n".join(map(str, FADING)))
    report = Report("cellular")
    bench(argparse.Namespace(data=tmp_path, quick=False, seconds=6.0), report)
    assert [row.system for row in report.rows] == [
        "poses alone",
        "sern",
        "sern, not following",
        "hybrid",
        "bbr-like",
        "cubic",
        "informed",
    ]
    assert {row.case for row in report.rows} == {"some lte up"}
    assert [reach.name for reach in report.reaches] == [
        "lte: share of the link that bulk uses",
        "lte: p95 of poses, times that of poses alone",
    ]
    beside, alone = (report.value("some lte up", system, "used_percent") for system in ("sern", "poses alone"))
    assert report.reaches[0].value == pytest.approx((beside - alone) / 100)


def test_without_recordings_it_says_what_to_give(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"holds no recordings of links \(\*.csv\): name a folder with --data"):
        bench(argparse.Namespace(data=tmp_path, quick=True, seconds=None), Report("cellular"))


def test_the_links_that_have_limits_are_known_by_their_names() -> None:
    assert [cellular.kind(name) for name in ("att_lte_driving_up", "verizon_evdo_driving_up", "wifi")] == [
        "lte",
        "evdo",
        None,
    ]
