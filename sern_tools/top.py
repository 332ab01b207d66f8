"""`sern top`: a daemon on one screen: its link, its configuration, and each topic with what is wrong with it.

It is made to be read over SSH at 80 columns: what is wrong is in colour and in words, and comes before what is well.
`watching.state` of the runtime reads the daemon's answers and `watching.why` finds the words, both also for the page
that a daemon serves; `top_text` makes the lines. All three are pure.
"""

import json
import os
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated, Any, Final, TextIO

import typer

from sern_core.vocabulary.errors import SernError
from sern_runtime.watching.state import EVENTS, Sample, View, read
from sern_runtime.watching.why import view
from sern_tools.api import NotFoundError, checked_api, drop_output, get_json, local_api, say
from sern_tools.terminal import EndedError, Terminal
from sern_tools.top_text import in_colour, screen
from sern_tools.topics import MIN_INTERVAL_S

PLAIN_WIDTH: Final = 100
"""Columns where the output is no terminal and COLUMNS says nothing."""
WINDOW_S: Final = 3.2
"""Rates are of so long."""


class TopWatcher:
    """Looks at one daemon again and again. `clock` in monotonic seconds."""

    def __init__(
        self, api: str, *, get: Callable[[str, str], Any] = get_json, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.api = api
        self._get = get
        self._clock = clock
        self._events: deque[Any] = deque(maxlen=EVENTS)
        self._boot, self._after = "", 0
        self._samples = deque([self._look()])

    def _look(self) -> Sample:
        get, api, at_s = self._get, self.api, self._clock()
        try:
            clients = get(api, "/api/clients")
            told = get(api, f"/api/events?after={self._after}&boot={self._boot}")
        except NotFoundError:
            raise SernError(f"{api}: the daemon is older than this program, or of another kind") from None
        if told["boot"] != self._boot:
            self._events.clear()  # of another process
        self._boot, self._after = told["boot"], told["last"]
        self._events.extend(told["events"])
        try:
            adaptation = get(api, "/api/mmcf?last=1")
        except NotFoundError:
            adaptation = None
        return read(at_s, clients, get(api, "/api/link"), get(api, "/api/topics"), adaptation, tuple(self._events))

    def view(self) -> View:
        """What changed within the last `WINDOW_S`, so that a topic of 1 Hz does not flicker; or since the call before.
        Raises SernError when the daemon does not answer."""
        now = self._look()
        samples = self._samples
        while len(samples) > 1 and now.at_s - samples[0].at_s > WINDOW_S:
            samples.popleft()
        seen = view(samples[0], now)
        samples.append(now)
        return seen


def run_once(
    api: str,
    *,
    as_json: bool,
    interval_s: float,
    out: TextIO,
    colour: bool,
    width: int,
    pause: Callable[[float], None] = time.sleep,
) -> None:
    """Write the screen once, all of it. Raises SernError."""
    watcher = TopWatcher(api)
    pause(2.0 * interval_s)
    seen = watcher.view()
    if as_json:
        out.write(json.dumps(asdict(seen), indent=1) + "\n")
        return
    for line in screen(seen, width, api=api):
        out.write(in_colour(line, colour=colour).rstrip() + "\n")


def run_lines(api: str, *, interval_s: float, out: TextIO, pause: Callable[[float], None] = time.sleep) -> None:
    """Write a line of JSON a look, until interrupted. Raises SernError."""
    watcher = TopWatcher(api)
    while True:
        pause(interval_s)
        out.write(json.dumps(asdict(watcher.view())) + "\n")
        out.flush()


def run_live(api: str, *, interval_s: float, colour: bool, terminal: Terminal) -> None:
    """Draw until `q`. A daemon that does not answer is waited for, and what it said last stays. Raises SernError when
    it does not answer at the beginning, EndedError for a signal."""
    watcher = TopWatcher(api)
    with terminal.drawing():
        seen: View | None = None
        problem = ""
        wait_s = min(interval_s, 0.5)  # the first look comes soon
        while True:
            if terminal.key(wait_s) in ("q", "Q"):
                return
            wait_s = interval_s
            try:
                seen, problem = watcher.view(), ""
            except SernError as error:
                problem = f"{error}; what follows is of before"
            width, height = terminal.size()
            what = [[(problem, "bad")]] if seen is None else screen(seen, width, height, api=api, problem=problem)
            terminal.draw([in_colour(line, colour=colour) for line in what])


def top(
    api: Annotated[
        str | None,
        typer.Option("--api", help="HTTP address of a daemon (http.listen in its file) [default: this machine's]."),
    ] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Write everything once; so it is where there is no terminal.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="JSON; without --once one line a look.")] = False,
    interval_s: Annotated[
        float, typer.Option("--interval", min=MIN_INTERVAL_S, help="Seconds between two looks; --once takes two.")
    ] = 1.0,
) -> None:
    """Show a daemon on one screen: link, configuration, topics, and in words why a topic is missing. `q` ends it.

    A robot's client says what leaves it, a site's what arrives, a relay both of its own hops. Colour shows what is
    wrong; NO_COLOR switches it off.

    Exit code 0 when ended by `q` or Ctrl-C, 1 when there is no daemon, 2 for wrong usage, 128 and more for a signal.
    """
    terminal = sys.stdout.isatty()
    colour = terminal and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
    try:
        address = checked_api(api or local_api())
        if as_json and not once:
            run_lines(address, interval_s=interval_s, out=sys.stdout)
        elif once or as_json or not terminal:
            width = Terminal().size()[0] if terminal or os.environ.get("COLUMNS") else PLAIN_WIDTH
            run_once(address, as_json=as_json, interval_s=interval_s, out=sys.stdout, colour=colour, width=width)
        else:
            run_live(address, interval_s=interval_s, colour=colour, terminal=Terminal())
    except KeyboardInterrupt:
        raise typer.Exit(0) from None
    except BrokenPipeError:
        drop_output()
    except EndedError as ended:
        raise typer.Exit(128 + ended.number) from None
    except SernError as error:
        raise typer.Exit(say("sern top", error)) from None
