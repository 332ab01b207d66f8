"""A link as it was recorded, for replays: what it carried, how long packets took, how many were lost, over time.

Three files are read:

- CSV with the columns time_s, rate_bps, delay_s, loss, in any order and others beside them. `delay_s` is one way,
  `loss` a share from 0 to 1. A row holds until the next. An empty rate: no limit; a rate of 0, or a loss of 1: the
  link is gone. Empty delay or loss: as before.
- What `/api/link` answered, a line each time, as `while sleep 1; do curl -s HOST/api/link; echo; done` writes it.
- What `/api/mmcf` answered, `mmcf.json` of a run of the lab (`benchmarks.mmcf_lab --traces`), or the folder with it.

A daemon knows what the link carries only while it is full: where it does not, what it knew last holds.
"""

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import inf, isfinite
from pathlib import Path
from typing import Any, Final, NamedTuple

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_sim.models import LinkModel, PathStep, RateStep, Window
from sern_sim.profiles import LinkProfile

COLUMNS: Final = ("time_s", "rate_bps", "delay_s", "loss")
LAB_FILE: Final = "mmcf.json"
LINES_S: Final = 1.0
"""Time between two answers that say no time."""
MIN_RATE_BPS: Final = 1.0
QUEUE_PACKETS: Final = 100


class State(NamedTuple):
    """The link from `at_s` on. None: as before, for the rate at first no limit. `up` False: nothing gets through."""

    at_s: float
    rate_bps: float | None
    delay_s: float | None
    loss: float | None
    up: bool = True


def is_recording(name: str) -> bool:
    """Whether `--link NAME` means a file and no profile."""
    return "/" in name or Path(name).suffix in (".csv", ".json", ".jsonl") or Path(name).exists()


def read_link(path: Path, *, peer: str | None = None, after_s: float = 0.0) -> LinkProfile:
    """The link of a file, the same both ways, over a datagram lane. `peer`: which link, where there are several.
    The first state holds from the start on, and `after_s` longer than it was recorded.

    Raises ConfigError of one line that names the file, and for a CSV the line.
    """
    path = path / LAB_FILE if path.is_dir() else path
    try:
        if path.suffix == ".csv":
            with path.open(encoding="utf-8", newline="") as file:
                states = list(_rows(path, file))
        else:
            states = list(_answers(path, path.read_text(encoding="utf-8"), peer))
    except OSError as error:
        raise ConfigError(f"cannot be read ({(error.strerror or str(error)).lower()})", file=str(path)) from None
    except UnicodeDecodeError:
        raise ConfigError("is not text", file=str(path)) from None
    if not states:
        raise ConfigError("holds no state of a link", file=str(path))
    try:
        return _profile(path.stem, states, after_s)
    except UsageError as error:
        raise ConfigError(str(error), file=str(path)) from None


def _profile(name: str, states: Sequence[State], after_s: float) -> LinkProfile:
    start_s = states[0].at_s - after_s
    rates: list[RateStep] = []
    paths: list[PathStep] = []
    gone: list[Window] = []
    rate_bps: float | None = None
    delay_s, loss = 0.0, 0.0
    down_s: float | None = None
    for index, state in enumerate(states):
        at_s = state.at_s - start_s if index else 0.0
        if state.up and down_s is not None:
            gone.append(Window(down_s, at_s))
            down_s = None
        elif not state.up and down_s is None:
            down_s = at_s
        if state.up and state.rate_bps is not None and state.rate_bps != rate_bps:
            rate_bps = None if state.rate_bps == inf else max(state.rate_bps, MIN_RATE_BPS)
            rates.append(RateStep(at_s, rate_bps))
        path = (
            delay_s if state.delay_s is None else state.delay_s,
            loss if state.loss is None or not state.up else state.loss,
        )
        if path != (delay_s, loss):
            delay_s, loss = path
            paths.append(PathStep(at_s, delay_s, loss))
    end_s = states[-1].at_s - start_s
    if down_s is not None:
        gone.append(Window(down_s, end_s + LINES_S))
    first = next((step.rate_bps for step in rates), None)  # what it carried before it was known
    begins = paths[0] if paths else PathStep(0.0, 0.0, 0.0)
    model = LinkModel(
        rate_bps=first,
        delay_s=begins.delay_s,
        loss=begins.loss,
        rate_steps=tuple(rates),
        path_steps=tuple(paths),
        blackouts=tuple(gone),
        queue_packets=QUEUE_PACKETS,
    )
    return LinkProfile(name, f"recorded, {end_s - after_s:.0f} s", model, model, max(end_s, LINES_S))


# --- CSV --------------------------------------------------------------------------------------------------------------


def _rows(path: Path, file: Iterable[str]) -> Iterator[State]:
    reader = csv.DictReader(file)
    missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise ConfigError(
            f"has no column {missing[0]}; the first line names the columns: {','.join(COLUMNS)}", file=str(path), line=1
        )
    last_s = -inf
    for row in reader:
        cells = {name: _cell(path, reader.line_num, name, row[name]) for name in COLUMNS}
        at_s, rate_bps, delay_s, loss = (cells[name] for name in COLUMNS)
        if at_s is None or at_s <= last_s:
            raise ConfigError("time_s must rise from row to row", file=str(path), line=reader.line_num)
        if loss is not None and loss > 1.0:
            raise ConfigError(f"loss is {loss:g}: a share from 0 to 1", file=str(path), line=reader.line_num)
        last_s = at_s
        up = rate_bps != 0.0 and loss != 1.0
        yield State(at_s, inf if rate_bps is None else rate_bps, delay_s, loss, up)


def _cell(path: Path, line: int, name: str, text: str | None) -> float | None:
    if text is None or not text.strip():
        return None
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not isfinite(value) or (value < 0.0 and name != "time_s"):
        raise ConfigError(f"{name} is {text.strip()!r}: a number of 0 or above", file=str(path), line=line)
    return value


# --- what daemons answered --------------------------------------------------------------------------------------------


def _answers(path: Path, text: str, peer: str | None) -> Iterator[State]:
    try:
        whole = json.loads(text)
    except ValueError:
        whole = None
    if isinstance(whole, dict) and "links" in whole:
        yield from _history(path, whole["links"], peer)
        return
    at_s = -LINES_S
    last_s = -inf
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            links = json.loads(line)
        except ValueError:
            links = None
        if not isinstance(links, list) or not all(isinstance(link, dict) and "peer" in link for link in links):
            raise ConfigError("is no answer of /api/link; one a line is expected", file=str(path), line=number)
        link = _chosen(path, links, peer)
        at_s = at_s + LINES_S if link is None else float(link.get("now_s", at_s + LINES_S))
        if at_s <= last_s:
            continue  # the daemon was started anew, or answered twice at once
        last_s = at_s
        yield _of_link(at_s, link)


def _of_link(at_s: float, link: Mapping[str, Any] | None) -> State:
    if link is None:
        return State(at_s, None, None, None, up=False)
    round_trip_s = link.get("rtprop_s") or link.get("srtt_s")
    delay_s = None if round_trip_s is None else float(round_trip_s) / 2
    return State(at_s, link.get("rate_bps") or None, delay_s, link.get("loss"), bool(link.get("up", True)))


def _history(path: Path, links: Sequence[Mapping[str, Any]], peer: str | None) -> Iterator[State]:
    chosen = _chosen(path, links, peer)
    for step in chosen["history"] if chosen is not None else ():
        link = step["link"]
        yield State(step["now_s"], link["capacity_bps"] or None, link["rtt_s"] / 2, link["loss"])


def _chosen(path: Path, links: Sequence[Mapping[str, Any]], peer: str | None) -> Mapping[str, Any] | None:
    names = [str(link["peer"]) for link in links]
    if peer is not None:
        return next((link for link in links if link["peer"] == peer), None)
    if len(links) > 1:
        raise ConfigError(f"has several links; choose one with --peer: {', '.join(names)}", file=str(path))
    return links[0] if links else None
