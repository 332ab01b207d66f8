"""The control socket of a lab that runs in another process: what `sern lab link` and `sern lab down` speak to.

One JSON object a line each way, on a Unix socket below `/run/sern-lab` that only root can reach:

    {"do": "link", "direction": "up", "changes": {"rate_bps": 1e6, "loss": 0.02}, "blackout": false}
    {"do": "profile", "name": "field-wifi"}, {"do": "show"}             all three are answered {"link": "..."}
    {"do": "down"}                                                      {"down": "..."}
    anything wrong                                                      {"error": "..."}
"""

import contextlib
import json
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from sern_core.vocabulary.errors import SernError, UsageError
from sern_sim.models import Jitter, LinkModel
from sern_sim.profiles import LinkProfile
from sern_tools.lab.host import LabError
from sern_tools.lab.lab import Lab, shaping
from sern_tools.lab.removal import RUN_DIR, alive, labs

ANSWER_S: Final = 60.0
"""A lab that is busy answers after its next step; a lab that goes down after it is gone."""
GONE_S: Final = 60.0
_MAX_REQUEST_BYTES: Final = 2**16

Answer = dict[str, Any]


def socket_path(lab: str) -> Path:
    return RUN_DIR / f"{lab}.sock"


def running() -> list[str]:
    """The labs that can be spoken to."""
    return [lab for lab in labs() if socket_path(lab).exists() and alive(lab)]


class Control:
    """Serves one lab and plays profiles on it, all in one thread: `serve` until somebody says `down`.

    `find_profile` turns a name into a profile; ConfigError when there is none of that name.
    """

    def __init__(self, lab: Lab, find_profile: Callable[[str], LinkProfile]) -> None:
        self.lab = lab
        self._find_profile = find_profile
        self._script: Iterator[tuple[float, LinkProfile, float]] | None = None
        self._next: tuple[float, LinkProfile, float] | None = None
        path = socket_path(lab.id)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            path.unlink(missing_ok=True)
            self._listener.bind(str(path))
            self._listener.listen()
        except OSError as error:
            self._listener.close()
            raise LabError(f"{path}: {error.strerror}") from error

    def close(self) -> None:
        self._listener.close()
        socket_path(self.lab.id).unlink(missing_ok=True)

    def play(self, profile: LinkProfile) -> None:
        """Play a profile's script from now on, once; its last state then stays."""
        began_s = time.monotonic()

        def script() -> Iterator[tuple[float, LinkProfile, float]]:
            at_s: float | None = 0.0
            while at_s is not None:  # flapping never ends
                yield began_s + at_s, profile, at_s
                at_s = profile.next_change_s(at_s)

        self._script = script()
        self._advance()
        self.step()

    def _advance(self) -> None:
        self._next = next(self._script, None) if self._script is not None else None

    def step(self) -> float | None:
        """Do what the script has due; how long until the next (None: nothing more)."""
        while self._next is not None:
            due_s, profile, at_s = self._next
            left_s = due_s - time.monotonic()
            if left_s > 0:
                return left_s
            self.lab.apply(profile, at_s=at_s)
            self._advance()
        return None

    def serve(self) -> None:
        """Answer until somebody says `down`; the lab is then still there."""
        while True:
            self._listener.settimeout(self.step())
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                continue
            with connection:
                connection.settimeout(ANSWER_S)
                with contextlib.suppress(OSError):  # whoever asked has gone
                    request = _read_line(connection)
                    answer = self.answer(request)
                    connection.sendall(json.dumps(answer).encode() + b"\n")
                    if "down" in answer:
                        return

    def answer(self, line: bytes) -> Answer:
        """The answer to one request."""
        try:
            request = json.loads(line)
            return self._do(request if isinstance(request, dict) else {})
        except ValueError:
            return {"error": "a request is one JSON object a line"}
        except SernError as error:
            return {"error": str(error)}

    def _do(self, request: dict[str, Any]) -> Answer:
        verb = request.get("do")
        if verb == "down":
            return {"down": self.lab.id}
        if verb == "profile":
            self.play(self._find_profile(str(request.get("name"))))
        elif verb == "link":
            self._script = self._next = None
            self._change(request)
        elif verb != "show":
            raise UsageError(f"{verb!r} is nothing that a lab does; it does link, profile, show and down")
        return {"link": describe(self.lab)}

    def _change(self, request: dict[str, Any]) -> None:
        direction = request.get("direction", "both")
        changes = _checked(request.get("changes") or {})
        if changes:
            self.lab.change(direction, **changes)
        if request.get("blackout") is not None:
            self.lab.blackout(bool(request["blackout"]), direction)


NUMBERS: Final = frozenset({"rate_bps", "delay_s", "jitter_s", "loss", "duplicate", "reorder", "queue_packets"})


def _checked(changes: object) -> dict[str, Any]:
    """What a request wants changed. UsageError for what is no parameter, or has no value that one can have."""
    if not isinstance(changes, dict):
        raise UsageError("changes is a mapping from parameters to values")
    checked: dict[str, Any] = {}
    for name, value in changes.items():
        if name == "jitter" and value in list(Jitter):
            checked[name] = Jitter(value)
        elif name in NUMBERS and isinstance(value, int | float) and not isinstance(value, bool):
            checked[name] = round(value) if name == "queue_packets" else value
        elif name == "rate_bps" and value is None:
            checked[name] = None
        else:
            raise UsageError(
                f"{name} cannot be {value!r}; there are: jitter ({', '.join(Jitter)}), numbers for "
                f"{', '.join(sorted(NUMBERS))}"
            )
    return checked


def describe(lab: Lab) -> str:
    """Both directions as netem's options, one line each."""

    def one(name: str, model: LinkModel, dark: bool) -> str:
        return f"{name:5} netem {shaping(model, dark=dark)}"

    up, down = lab.dark
    return f"{one('up', lab.up, up)}\n{one('down', lab.down, down)}"


def ask(lab: str, request: dict[str, Any]) -> Answer:
    """Send a request to a lab and return its answer. SernError with its words when it refuses, or is not there."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(ANSWER_S)
        try:
            connection.connect(str(socket_path(lab)))
            connection.sendall(json.dumps(request).encode() + b"\n")
            line = _read_line(connection)
        except OSError as error:
            raise LabError(f"lab {lab} does not answer: {error.strerror or error}") from error
    if not line:
        raise LabError(f"lab {lab} ended instead of answering")
    answer: Answer = json.loads(line)
    if "error" in answer:
        raise LabError(str(answer["error"]))
    return answer


def _read_line(connection: socket.socket) -> bytes:
    data = b""
    while not data.endswith(b"\n") and len(data) < _MAX_REQUEST_BYTES:
        chunk = connection.recv(4096)
        if not chunk:
            break
        data += chunk
    return data


def take_down(lab: str) -> None:
    """Have the process of a lab remove it and wait until it has. LabError when it stays."""
    try:
        ask(lab, {"do": "down"})
    except LabError:
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(lab.partition(".")[0]), signal.SIGTERM)
    give_up_s = time.monotonic() + GONE_S
    while lab in labs() and alive(lab):
        if time.monotonic() > give_up_s:
            raise LabError(f"lab {lab} does not end: kill its process {lab.partition('.')[0]}, then sern lab down")
        time.sleep(0.02)
