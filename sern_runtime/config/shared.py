"""Sections that relay and client files have in common; defaults come from the dataclasses that the core reads."""

import os
import time
from collections.abc import Iterator
from enum import StrEnum
from math import inf
from pathlib import Path
from typing import Annotated, Final, Literal, Self, get_args

from pydantic import Field, model_validator

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.params import LinkParams, Redundancy, SchedulerParams, WindowAlgorithm, WindowParams
from sern_core.vocabulary.types import Ordering
from sern_runtime.config.base import (
    Bytes,
    FileProblem,
    HttpListen,
    PathText,
    Seconds,
    SecondsOrZero,
    Section,
    described,
    fault,
    is_local,
    resolve,
    unit_makes,
    unit_problems,
)
from sern_runtime.config.keys import PUBLIC_SUFFIX, load_public, load_secret, load_server_keys, secret_warning
from sern_runtime.config.tokens import read_token, token_problems
from sern_runtime.config.yaml import Loc
from sern_runtime.dscp import DSCP_NAMES, Marks
from sern_runtime.durable.names import DURABLE_FILE
from sern_runtime.http_access import HttpAccess

ClassWord = Literal["control", "state", "bulk"]
DscpName = Literal[
    "cs0", "le", "cs1", "cs2", "cs3", "cs4", "cs5", "cs6", "cs7",
    "af11", "af12", "af13", "af21", "af22", "af23", "af31", "af32", "af33", "af41", "af42", "af43",
    "va", "ef",
]  # fmt: skip
DscpValue = Annotated[
    DscpName | Annotated[int, Field(ge=0, le=63)], described("a DSCP: a name such as ef, af41 or cs1, or 0 to 63")
]
_MARKS = Marks()
_SCHEDULER = SchedulerParams()
_LINK = LinkParams()


class SchedulerSection(Section):
    """Which message the link carries next. P(m) = κ[1 + η·a(m)] / (s(m) + ε), the paper's eq. (priority_score)."""

    ordering: Ordering = _SCHEDULER.ordering
    """`class`: more urgent classes first, P within a class, fragments and floors; `paper`: Alg. prioritize as printed,
    without fragments."""
    eta: Annotated[float, Field(ge=0, le=1e6)] = _SCHEDULER.eta
    """η in 1/s: how much one second of waiting raises a score. 0: no ageing."""
    epsilon_bytes: Annotated[float, Field(gt=0, le=1e9)] = _SCHEDULER.epsilon_bytes
    """ε: keeps tiny messages from winning on size alone; about the overhead of one fragment."""
    a_max_s: SecondsOrZero = _SCHEDULER.a_max_s
    """Ages count up to here."""
    interval_s: Annotated[float, Field(gt=0, le=10)] = _SCHEDULER.interval_s
    """Δt: the budget of bytes is set once an interval."""
    floor: Annotated[float, Field(ge=0, lt=0.5)] = _SCHEDULER.floor
    """Share of the link that each lower class keeps while more urgent ones are backlogged."""
    class0_share: Annotated[float, Field(gt=0, le=1)] = _SCHEDULER.class0_share
    """Largest share of the link for class control while others are backlogged."""

    def params(self) -> SchedulerParams:
        return SchedulerParams(
            ordering=self.ordering,
            eta=self.eta,
            epsilon_bytes=self.epsilon_bytes,
            a_max_s=self.a_max_s,
            interval_s=self.interval_s,
            floor=self.floor,
            class0_share=self.class0_share,
        )


class WindowSection(Section):
    """How many bytes may be in flight."""

    algorithm: WindowAlgorithm = _LINK.window.algorithm
    """`hybrid`: by measured delay and rate, keeps the standing queue short; `fixed`: always `fixed_bytes`."""
    fixed_bytes: Bytes = _LINK.window.fixed_bytes
    """The window of algorithm `fixed`: capacity × round-trip time."""
    variable_rate_queue_s: Annotated[float, Field(gt=0, le=1)] | None = _LINK.window.variable_rate_queue_s
    """How long a queue to keep while the rate of the link goes up and down all the time, as that of a cellular one does
    to a robot that drives: the queue shows what the link can do now. With a longer one bulk uses more of the link, and
    poses wait so much longer. null: treat such a link as any other; bulk gets less, and fades may be taken for other
    traffic, which makes poses seconds old."""

    def params(self) -> WindowParams:
        return WindowParams(self.algorithm, self.fixed_bytes, self.variable_rate_queue_s)


def _name_of(number: int) -> DscpName:
    names: dict[int, DscpName] = {DSCP_NAMES[name]: name for name in get_args(DscpName)}
    return names[number]


class DscpSection(Section):
    """The mark (DSCP) on each IP packet, by which access points and routers on the way know what is urgent. A datagram
    has that of the most urgent class in it, a connection for class control alone that of `control`, every other
    connection and what carries no message that of `state`."""

    control: DscpValue = _name_of(_MARKS.control)
    """Class control. `ef` goes ahead of everything where a network has such a queue (voice in Wi-Fi)."""
    state: DscpValue = _name_of(_MARKS.state)
    """Class state. `cs0` is what unmarked traffic gets, on Wi-Fi between the other two; `af41` would share a queue with
    `ef` there."""
    bulk: DscpValue = _name_of(_MARKS.bulk)
    """Class bulk. `cs1` gives way to everything else where a network has such a queue (background in Wi-Fi)."""

    def marks(self) -> Marks:
        return Marks(_code_point(self.control), _code_point(self.state), _code_point(self.bulk))


def _code_point(value: DscpName | int) -> int:
    return value if isinstance(value, int) else DSCP_NAMES[value]


class LinkSection(Section):
    """The link between this daemon and its peer."""

    window: WindowSection = WindowSection()
    """The window of bytes in flight."""
    fragment_bytes_max: Annotated[int, Field(ge=1200, le=65_000)] = _LINK.fragment_bytes_max
    """Largest fragment; the size used is what the link carries in 3 ms, at least 1200."""
    stream_from_bps: Annotated[float, Field(gt=0)] | None = _LINK.stream_from_bps
    """While datagrams carry so many bits per second, lose nothing, and take at most 30 ms there and back, data goes
    over TCP in large pieces, which cost a fraction of the CPU, and back to datagrams when the path gets thin or stands
    still. null: data stays with the datagrams."""
    heartbeat_timeout_s: Annotated[float, Field(ge=0.5, le=600)] = _LINK.heartbeat_timeout_s
    """A peer that is silent for so long is gone, and its connection is rebuilt. Satellite links need more than 2 s."""
    retention_s: Seconds = _LINK.retention_s
    """How long an undelivered reliable message is kept when its topic has no `retention_s`."""
    redundancy: Redundancy = _LINK.redundancy
    """Class control sent twice over the datagram lane: `auto` while it loses packets, `always`, or `off`. While
    something waits for the link, what exceeds class control's share of it is not copied."""
    dscp: DscpSection = DscpSection()
    """Marks of the classes on IP packets."""
    max_message_bytes: Annotated[int, Field(ge=1024, le=1 << 30)] = _LINK.max_message_bytes
    """Larger messages are dropped and counted as `too_large`."""
    drain_s: Annotated[float, Field(ge=0, le=3600)] = 20.0
    """How long a daemon that is stopped goes on delivering what waits, at the most: it ends before when nothing is left
    or nothing moves any more. A service manager must allow for it (systemd: TimeoutStopSec)."""

    def params(self) -> LinkParams:
        return LinkParams(
            window=self.window.params(),
            fragment_bytes_max=self.fragment_bytes_max,
            stream_from_bps=inf if self.stream_from_bps is None else self.stream_from_bps,
            heartbeat_timeout_s=self.heartbeat_timeout_s,
            retention_s=self.retention_s,
            redundancy=self.redundancy,
            max_message_bytes=self.max_message_bytes,
        )


class HttpSection(Section):
    """The HTTP server with the page to watch it by, /metrics, /healthz and /readyz."""

    listen: HttpListen | None = None
    """`address:port`, such as 127.0.0.1:5581; null: no HTTP server. Beyond loopback `token_file` is needed."""
    token_file: PathText | None = None
    """A file with one line, the token that whoever asks must send (`Authorization: Bearer TOKEN`) for all but /healthz
    and /readyz; null: whoever is on this machine may ask. Nothing is encrypted: beyond loopback use a private network,
    or a proxy with TLS."""

    @model_validator(mode="after")
    def _is_closed(self) -> Self:
        listen = self.listen
        if listen is not None and self.token_file is None and not is_local(f"tcp://{listen}"):
            raise fault(
                f"{listen} is open to the network: set http.token_file, or listen on 127.0.0.1 and come through an SSH "
                "tunnel (ssh -L)",
                "listen",
            )
        return self

    def problems(self, base_dir: Path) -> Iterator[FileProblem]:
        """Problems of the token's file, as the whole file's own."""
        return token_problems(base_dir, self.token_file, ("http", "token_file"))

    def access(self, base_dir: Path) -> HttpAccess:
        """Who may ask. Raises ConfigError when the token cannot be read."""
        token = None if self.token_file is None else read_token(resolve(base_dir, self.token_file))
        return HttpAccess(token)


class LogLevel(StrEnum):
    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class LogFormat(StrEnum):
    TEXT = "text"
    JSON = "json"


class LocalSection(Section):
    """The socket on which tools of this machine change what runs: `sern set`, `sern take`, `sern release`."""

    listen: bool = True
    """Whether there is one. It has mode 0600: this client's user and root may use it."""
    socket: PathText | None = None
    """Its path; null: NAME.sock in the unit's runtime directory, else in $XDG_RUNTIME_DIR/sern or /tmp/sern-UID."""


class LogSection(Section):
    """The log, on standard error."""

    level: LogLevel = LogLevel.INFO
    """The least severe messages that are written."""
    format: LogFormat = LogFormat.TEXT
    """`text`: a line a person reads; `json`: one object a line."""


class DurableSection(Section):
    """What is kept on disk of durable topics."""

    directory: PathText
    """A directory for it alone, made if it is not there, on a disk that keeps what it was told to sync. Each daemon
    needs its own."""
    max_bytes: Bytes = 256 * 2**20
    """Bytes kept at most, over all topics; beyond, new messages are refused to their publisher."""

    def problems(self, base_dir: Path) -> Iterator[FileProblem]:
        """Problems of the directory, as the file's own."""
        directory = resolve(base_dir, self.directory)
        yield from output_problems(
            base_dir, str(directory / DURABLE_FILE if directory.is_dir() else directory), DIRECTORY
        )


DIRECTORY: Final[Loc] = ("durable", "directory")


def public_key_problems(base_dir: Path, text: PathText, loc: Loc, *, client: str) -> Iterator[FileProblem]:
    """Problems of the relay's public key file, as `client` has it."""
    path = resolve(base_dir, text)
    try:
        load_server_keys(path, at_s=time.time())
        keys = load_public(path)
    except ConfigError as error:
        yield FileProblem(loc, str(error))
        return
    if keys.name == client:
        yield FileProblem(loc, f"{path} is the key of {client}, this client; the relay's is needed", warning=True)


def secret_key_problems(base_dir: Path, text: PathText, loc: Loc, *, owner: str) -> Iterator[FileProblem]:
    """Problems of the secret key file of `owner`, the name that the configuration gives to this daemon, and of the
    public one beside it, which is what people copy."""
    path = resolve(base_dir, text)
    try:
        key = load_secret(path)
    except ConfigError as error:
        yield FileProblem(loc, str(error))
        return
    if key.name != owner:
        yield FileProblem(loc, f"{path} is the key of {key.name}, and this is {owner}; use the key of {owner}")
    warning = secret_warning(path)
    if warning is not None:
        yield FileProblem(loc, warning, warning=True)
    public = path.with_suffix(PUBLIC_SUFFIX)
    if not public.is_file():
        return
    try:
        keys = load_public(public)
    except ConfigError as error:
        yield FileProblem(loc, f"beside it is {error}", warning=True)
        return
    if key.public_key not in {entry.key for entry in keys.keys}:
        problem = (
            f"{public} is not its public half (it holds the key of {keys.name}): whoever copies it has the wrong one"
        )
        yield FileProblem(loc, problem, warning=True)
    elif keys.name != key.name:
        problem = f"{public} says that this is the key of {keys.name}, and it is that of {key.name}"
        yield FileProblem(loc, problem, warning=True)


def output_problems(base_dir: Path, text: PathText | None, loc: Loc) -> Iterator[FileProblem]:
    """Problems of a file that will be written: its directory must be there and writable."""
    if text is None:
        return
    path = resolve(base_dir, text)
    if path.is_dir():
        yield FileProblem(loc, f"{path} is a directory; a file is needed")
    elif not path.parent.is_dir() and unit_makes(base_dir, path.parent):
        return
    elif not path.parent.is_dir():
        yield FileProblem(loc, f"{path.parent}: no such directory; create it first")
    elif not os.access(path.parent, os.W_OK):
        yield FileProblem(loc, f"{path.parent}: may not be written")
    else:
        yield from unit_problems(base_dir, path, loc)
