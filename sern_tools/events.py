"""`sern events`: what happens to the links of a daemon, as it happens, a line of JSON each.

The daemon is asked for what came after the last event that was written, and answers when there is something: nothing is
asked for again and again. What went wrong meanwhile is on standard error; in the stream it is an event of kind
`missed` (events that the daemon no longer had) or `restarted` (another process answers, its numbers begin anew).
"""

import json
import os
import select
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Final, TextIO

import typer

from sern_core.vocabulary.errors import SernError
from sern_tools.api import NotFoundError, checked_api, drop_output, get_json, local_api, say

PATH: Final = "/api/events"
WAIT_S: Final = 10.0
"""How long an answer without an event is waited for; then it is asked again."""
ANSWER_S: Final = 5.0
"""How much longer the daemon may take before it counts as gone."""
PAUSE_S: Final = 0.2
"""Between two answers with events: what comes meanwhile comes together."""
RETRY_S: Final = 1.0
LAST: Final = 20

Event = Mapping[str, Any]


class Follower:
    """The events of one daemon, in their order. `warn` is told what went wrong, a line each; `get` asks the daemon."""

    def __init__(
        self,
        api: str,
        *,
        get: Callable[..., Any] = get_json,
        warn: Callable[[str], None] | None = None,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self._api = api
        self._get = get
        self._warn = warn or (lambda line: print(f"sern events: {line}", file=sys.stderr))
        self._pause = pause
        self._boot = ""
        self._after = 0

    def begin(self, last: int) -> list[Event]:
        """The last events that the daemon has, `last` at most. Raises SernError when it does not answer."""
        try:
            answer = self._get(self._api, PATH)
        except NotFoundError:
            raise SernError(
                f"{self._api}: the daemon is older than this program, or of another kind, and tells no events"
            ) from None
        self._boot, self._after = answer["boot"], answer["last"]
        return list(answer["events"][-last:]) if last else []

    def follow(self) -> Iterator[Event | None]:
        """What comes from then on, for ever; None now and then, when nothing came."""
        lost_s: float | None = None
        while True:
            query = f"{PATH}?after={self._after}&boot={self._boot}&wait_s={WAIT_S:g}"
            try:
                answer = self._get(self._api, query, timeout_s=WAIT_S + ANSWER_S)
            except SernError as error:
                if lost_s is None:
                    lost_s = time.monotonic()
                    self._warn(f"{error} (trying again)")
                yield None
                self._pause(RETRY_S)
                continue
            anew = answer["boot"] != self._boot
            if lost_s is not None or anew:
                away = "" if lost_s is None else f", after {time.monotonic() - lost_s:.0f} s"
                self._warn(f"{self._api} answers again{away}{'; it was started anew' if anew else ''}")
                lost_s = None
            yield from self._taken(answer, anew=anew)
            if answer["events"]:
                self._pause(PAUSE_S)
            else:
                yield None

    def _taken(self, answer: Mapping[str, Any], *, anew: bool) -> Iterator[Event]:
        if anew:
            yield {"kind": "restarted", "time": answer["time"], "text": "another process of the daemon answers"}
        if answer["missed"]:
            text = f"{answer['missed']} events were missed: they came faster than they were read"
            self._warn(text)
            yield {"kind": "missed", "time": answer["time"], "text": text, "count": answer["missed"]}
        self._boot, self._after = answer["boot"], answer["last"]
        yield from answer["events"]


def run_events(follower: Follower, *, last: int, once: bool, out: TextIO | None = None) -> None:
    """Write events to `out` until interrupted, or those that there are, with `once`. SernError at the beginning;
    BrokenPipeError when nobody reads any more."""
    out = out or sys.stdout
    for event in follower.begin(last):
        out.write(json.dumps(event) + "\n")
    out.flush()
    if once:
        return
    for found in follower.follow():
        if found is not None:
            out.write(json.dumps(found) + "\n")
            out.flush()
        elif _abandoned(out):
            raise BrokenPipeError


def _abandoned(out: TextIO) -> bool:
    """Whether nobody can read what is written there any more."""
    try:
        number = out.fileno()
        os.fstat(number)
    except (OSError, ValueError):
        return False
    poll = select.poll()
    poll.register(number, 0)
    return any(events & select.POLLERR for _number, events in poll.poll(0))


def events(
    api: Annotated[
        str | None,
        typer.Option("--api", help="HTTP address of a daemon (http.listen in its file) [default: this machine's]."),
    ] = None,
    last: Annotated[int, typer.Option("--last", "-n", min=0, help="How many of before are told first.")] = LAST,
    once: Annotated[bool, typer.Option("--once", help="Only those of before.")] = False,
) -> None:
    """Follow what happens to a daemon's links, until Ctrl-C: who came, was lost, was refused, took over. JSON lines.

    A relay tells of all its clients, a client of its own link and of the robots or sites that it has to do with. When
    the daemon is started anew this goes on, and says so.

    Exit code 0 when ended by Ctrl-C, or when nobody reads any more, 1 when there is no daemon, 2 for wrong usage.
    """
    try:
        run_events(Follower(checked_api(api or local_api())), last=last, once=once)
    except KeyboardInterrupt:
        raise typer.Exit(0) from None
    except BrokenPipeError:
        drop_output()
    except SernError as error:
        raise typer.Exit(say("sern events", error)) from None
