"""Recorded links: what is read of a file, and one line for what cannot be."""

import json
from pathlib import Path
from typing import Any

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_sim.models import PathStep, RateStep, Window
from sern_tools.recorded_link import is_recording, read_link


def written(tmp_path: Path, name: str, *lines: str) -> Path:
    path = tmp_path / name
    path.write_text("\n".join(lines) + "\n")
    return path


def answer(now_s: float, rate_bps: float | None, **more: Any) -> str:
    link = {"peer": "relay", "up": True, "now_s": now_s, "rate_bps": rate_bps, "rtprop_s": 0.04, "loss": 0.0}
    return json.dumps([link | more])


def test_a_csv_gives_rate_delay_and_loss_over_time(tmp_path: Path) -> None:
    profile = read_link(
        written(
            tmp_path,
            "van.csv",
            "time_s,note,rate_bps,delay_s,loss",
            "100,start,2e6,0.02,0",
            "101.5,,5e5,0.1,0.05",
            "103,tunnel,0,,",
            "107,,,0.02,0",
        )
    )
    model = profile.up
    assert profile.name == "van" and profile.symmetric
    assert model.rate_steps == (RateStep(0.0, 2e6), RateStep(1.5, 5e5), RateStep(7.0, None))
    assert model.path_steps == (PathStep(0.0, 0.02, 0.0), PathStep(1.5, 0.1, 0.05), PathStep(7.0, 0.02, 0.0))
    assert model.blackouts == (Window(3.0, 7.0),)
    later = read_link(tmp_path / "van.csv", after_s=1.0).up
    assert later.rate_steps[:2] == (RateStep(0.0, 2e6), RateStep(2.5, 5e5)) and later.blackouts == (Window(4.0, 8.0),)


def test_polled_answers_of_api_link(tmp_path: Path) -> None:
    """Where the rate is not known, what was known last holds; a line without a link is a daemon without one."""
    path = written(
        tmp_path,
        "link.jsonl",
        answer(10.0, None),
        answer(11.0, 1e6),
        "",
        answer(12.0, None, rtprop_s=None, srtt_s=0.2),
        answer(13.0, 0.4e6, up=False),
        "[]",
        answer(15.5, 0.4e6, loss=0.1),
    )
    model = read_link(path).up
    assert model.rate_bps == 1e6
    assert model.rate_steps == (RateStep(1.0, 1e6), RateStep(5.5, 0.4e6))
    assert model.blackouts == (Window(3.0, 5.5),)
    assert [step.loss for step in model.path_steps] == [0.0, 0.0, 0.0, 0.1]
    assert [step.delay_s for step in model.path_steps] == [0.02, 0.1, 0.02, 0.02]


def test_a_run_of_the_lab(tmp_path: Path) -> None:
    link = {"capacity_bps": 300_000, "rtt_s": 0.1, "loss": 0.02}
    history = [{"now_s": 5.0, "link": link | {"capacity_bps": None}}, {"now_s": 6.0, "link": link}]
    (tmp_path / "mmcf.json").write_text(json.dumps({"links": [{"peer": "relay", "history": history}], "weights": {}}))
    model = read_link(tmp_path).up
    assert model.rate_bps == 300_000 and model.delay_s == 0.05 and model.loss == 0.02


@pytest.mark.parametrize(
    ("name", "lines", "said"),
    [
        ("a.csv", ["time,rate"], "a.csv:1: has no column time_s; the first line names the columns: time_s,rate_bps"),
        ("b.csv", ["time_s,rate_bps,delay_s,loss", "0,fast,0,0"], "b.csv:2: rate_bps is 'fast': a number of 0"),
        ("c.csv", ["time_s,rate_bps,delay_s,loss", "1,,0,0", "1,,0,0"], "c.csv:3: time_s must rise"),
        ("d.csv", ["time_s,rate_bps,delay_s,loss", "1,,0,2"], "d.csv:2: loss is 2: a share from 0 to 1"),
        ("e.csv", ["time_s,rate_bps,delay_s,loss"], "e.csv: holds no state of a link"),
        ("f.jsonl", ["[]", "never"], "f.jsonl:2: is no answer of /api/link"),
        ("g.jsonl", ['[{"peer": "a"}, {"peer": "b"}]'], "g.jsonl: has several links; choose one with --peer: a, b"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, name: str, lines: list[str], said: str) -> None:
    with pytest.raises(ConfigError) as error:
        read_link(written(tmp_path, name, *lines))
    assert said in str(error.value) and "\n" not in str(error.value)


def test_a_file_that_is_not_there_is_named() -> None:
    with pytest.raises(ConfigError, match=r"/nowhere/link.csv: cannot be read"):
        read_link(Path("/nowhere/link.csv"))


def test_what_means_a_file() -> None:
    assert is_recording("van.csv") and is_recording("./van") and is_recording("link.jsonl")
    assert not is_recording("step")
