"""`sern echo TOPIC`: print the messages of a topic as they pass, as text that is YAML.

It asks the daemon on this machine (`--api`, as `sern topics` does), which needs no key: it polls it for the latest
value, which a relay has of every topic that somebody takes, and a client of those that pass it.

With `--relay` or `--config` it is a client of the relay like any other, with a key and a name of its own: so access
rules hold, what it prints is every message that a site would get, and its ages are a site's. It must not borrow the
name of a client that runs: one name has one connection, and what is delivered to it counts as delivered. When it ends
it takes its subscription back, so that the relay keeps nothing for it.
"""

import asyncio
import base64
import logging
import re
import secrets
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Annotated, Any, Final, TextIO
from urllib.parse import quote

import typer
import zmq
from pydantic import ValidationError

from sern_client.transport import RelayTransport
from sern_core.link.handshake import DISPLACED, NEW_SESSION
from sern_core.site.client import ClientCore
from sern_core.vocabulary.errors import ConfigError, RefusedError, SernError, UsageError
from sern_core.vocabulary.key_news import RelayKeys
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.names import client_name, name_problem
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, TopicName
from sern_core.wire import framing
from sern_runtime import clock
from sern_runtime.config.client import RelayConnection, load_client
from sern_runtime.config.keys import SecretKey, load_secret, load_server_keys
from sern_runtime.loop import Shutdown, run
from sern_runtime.zmq_setup import HANDSHAKE_IVL_MS
from sern_tools.api import NotFoundError, checked_api, drop_output, get_json, is_stream, local_api, say
from sern_tools.echo_text import Decoder

DEFAULT_TIMEOUT_S: Final = 5.0
POLL_S: Final = 0.5
RATE_INTERVAL_S: Final = 1.0
LEAVE_S: Final = 1.0
"""How long to wait for the relay to take the subscription back; its `resume_s` ends it otherwise."""
RIVAL_TURNS: Final = 3
"""New sessions on one connection, after which somebody else must be using our name."""
UNHEARD: Final = "the relay does not answer"
"""The reason while nothing has come of the connection, neither way."""
TAKEN: Final = "another process connected as "
DAEMON_S: Final = 1.0
"""How long to wait for an answer of the daemon whose name we would take."""
_CHECK_S: Final = 0.05


# --- what is printed ------------------------------------------------------------------------------------------------


class Printer:
    """Prints messages one after another, `---` between them, each below a comment that says whence and how old."""

    def __init__(self, decoder: Decoder, out: TextIO, *, count: int | None) -> None:
        self._decoder = decoder
        self._out = out
        self._left = count

    def opened(self, stream: StreamInfo) -> None:
        info = stream.info
        self._decoder.prepare(stream.id.topic, info.type_name, info.definition, info.encoding)

    def show(self, stream: StreamInfo, message: Message, age_s: float) -> bool:
        """True when that was the last one."""
        comment = f"# {stream.id.origin} seq {message.seq} age {age_s:.3f} s" + (" replay" * message.replay)
        return self.write(comment, stream.id.topic, stream.info.type_name, stream.info.encoding, message.body)

    def write(self, comment: str, topic: str, type_name: str, encoding: Encoding, body: bytes) -> bool:
        text = self._decoder.text(topic, type_name, encoding, body)
        self._out.write(f"{comment}\n{text}\n---\n")
        self._out.flush()
        if self._left is not None:
            self._left -= 1
        return self._left == 0

    def lost(self, stream: StreamInfo, count: int, reason: str) -> None:
        self._out.write(f"# {stream.id.origin}: {count} reliable message(s) will not come: {reason}\n---\n")
        self._out.flush()

    def tick(self) -> bool:
        return False


class RatePrinter:
    """Counts in place of printing: one line a second with rate, bytes, ages, and gaps in the sequence."""

    def __init__(self, out: TextIO, *, count: int | None) -> None:
        self._out = out
        self._left = count
        self._ages_s: list[float] = []
        self._bytes = 0
        self._missed = 0
        self._total = self._total_missed = 0
        self._last_seq: dict[StreamId, int] = {}
        self._since_s = clock.now()

    def opened(self, stream: StreamInfo) -> None:
        """Any type can be counted."""
        if not self._last_seq:
            self._since_s = clock.now()

    def show(self, stream: StreamInfo, message: Message, age_s: float) -> bool:
        last = self._last_seq.get(stream.id)
        if last is not None and message.seq > last + 1:
            self._missed += message.seq - last - 1
        self._last_seq[stream.id] = max(message.seq, last or 0)
        self._ages_s.append(age_s)
        self._bytes += len(message.body)
        return False

    def lost(self, stream: StreamInfo, count: int, reason: str) -> None:
        """Seen as a gap."""

    def tick(self) -> bool:
        """Called often; a line when its second is over. True when that was the last one."""
        interval_s = clock.now() - self._since_s
        if interval_s < RATE_INTERVAL_S:
            return False
        ages = sorted(self._ages_s)
        age = f"age p50 {ages[len(ages) // 2]:.3f} max {ages[-1]:.3f} s" if ages else "no messages"
        hertz, kilobytes = len(ages) / interval_s, self._bytes / interval_s / 1000
        self._total += len(ages)
        self._total_missed += self._missed
        totals = f"(in all {self._total}, {self._total_missed})"
        self._out.write(f"{hertz:7.1f} Hz {kilobytes:9.1f} kB/s  {age}  not here {self._missed}  {totals}\n")
        self._out.flush()
        self._ages_s.clear()
        self._bytes = self._missed = 0
        self._since_s += interval_s
        if self._left is not None:
            self._left -= 1
        return self._left == 0


# --- as a client of the relay -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Identity:
    """Who we are to which relay."""

    name: ClientName
    endpoint: str
    keys: SecretKey | None
    server_keys: tuple[str, ...]
    link: LinkParams
    scheduler: SchedulerParams
    http: str | None = None  # where the daemon of the same name would answer
    handshake_interval_s: float = HANDSHAKE_IVL_MS / 1000


def identity_from_file(path: Path) -> Identity:
    """The name, relay and link of a client file; the rest of the file does not matter. Raises ConfigError."""
    loaded = load_client(path, files=False)
    model = loaded.model
    relay = model.all_relays[0]
    return Identity(
        model.name,
        relay.endpoint,
        load_secret(loaded.resolve(relay.secret_key_file)) if relay.secret_key_file else None,
        load_server_keys(loaded.resolve(relay.server_key_file), at_s=time.time()) if relay.server_key_file else (),
        model.link.params(),
        model.scheduler.params(),
        model.http.listen,
        relay.handshake_interval_s,
    )


def identity_from_options(endpoint: str, key: Path | None, server_key: Path | None, name: str | None) -> Identity:
    """The keys of the command line: both key files, or a `name` alone for a relay on this machine with `insecure:
    true`."""
    if (key is None) != (server_key is None) or (key is None) == (name is None):
        raise UsageError("give --key and --server-key, or --name alone for an insecure relay on this machine")
    try:
        RelayConnection(
            endpoint=endpoint,
            server_key_file=None if server_key is None else str(server_key),
            secret_key_file=None if key is None else str(key),
            insecure=key is None,
        )
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        option = {"insecure": "--name"}.get(str(detail["loc"][-1]) if detail["loc"] else "", "--relay")
        raise UsageError(f"{option} {endpoint}: {detail['msg']}") from None
    pair = None if key is None else load_secret(key)
    return Identity(
        client_name(name) if pair is None and name is not None else ClientName("") if pair is None else pair.name,
        endpoint,
        pair,
        () if server_key is None else load_server_keys(server_key, at_s=time.time()),
        LinkParams(),
        SchedulerParams(),
    )


class Listener:
    """`ClientEvents` of a client that only listens. `problem` is set when it cannot go on, `done` when it need not."""

    def __init__(self, printer: Printer | RatePrinter, warn: Callable[[str], None]) -> None:
        self.done = False
        self.problem: SernError | None = None
        self.ups = 0
        self.turns = 0
        self.streams: set[StreamId] = set()
        self.left = asyncio.Event()
        """Set while the relay has no stream open towards us."""
        self.left.set()
        self.seen = False
        self._printer = printer
        self._warn = warn

    def link_up(self, *, resumed: bool) -> None:
        if self.ups and self.turns == 0:
            self._warn("connected again")
        self.ups += 1

    def link_down(self, reason: str) -> None:
        if reason == NEW_SESSION:
            self.turns += 1
        elif not self.done and not reason.startswith(TAKEN):  # `rejected` says it next
            self._warn(f"link down: {reason}; waiting")

    def lane_offered(self, parameters: framing.Envelope) -> None:
        """Never asked for: one lane is enough to look."""

    def lane_closed(self) -> None:
        """There is none."""

    def keys_told(self, keys: RelayKeys) -> None:
        """Whoever looks has the daemon's keys, and leaves them to it."""

    def rejected(self, code: str, text: str) -> None:
        if code == DISPLACED:  # the guest gives way
            self.problem = RefusedError(code, f"{text}: sern keygen client NAME")
            return
        self.problem = RefusedError(code, f"the relay refuses us: {text}")

    def stream_opened(self, stream: StreamInfo) -> None:
        self.seen = True
        try:
            self._printer.opened(stream)
        except SernError as error:
            self.problem = error
            raise ConfigError(str(error)) from None
        self.streams.add(stream.id)
        self.left.clear()

    def stream_closed(self, stream: StreamInfo) -> None:
        self.streams.discard(stream.id)
        if not self.streams:
            self.left.set()
        if not self.done:
            self._warn(f"{stream.id.topic} of {stream.id.origin} has ended")

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        self._print(lambda: self._printer.show(stream, message, message.age_s(now)))

    def _print(self, write: Callable[[], bool | None]) -> None:
        """`write` says whether that was all."""
        if self.done or self.problem is not None:
            return
        try:
            self.done = bool(write())
        except SernError as error:
            self.problem = error
        except BrokenPipeError:  # nobody reads any more
            drop_output()
            self.done = True

    def expired(self, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        self._print(lambda: self._printer.lost(stream, 1, str(reason)))

    def skipped(self, stream: StreamInfo, count: int) -> None:
        self._print(lambda: self._printer.lost(stream, count, "given up before we were told of them"))

    def send_dropped(self, stream: StreamInfo, first: int, count: int, reason: DropReason, where: str) -> None:
        """We send nothing."""

    def wanted(self, stream: StreamInfo, wanted: bool) -> None:
        """We send nothing."""

    def publication_refused(self, stream: StreamInfo, code: str, text: str) -> None:
        """We send nothing."""

    def undecodable(self, stream: StreamInfo, problem: str) -> None:
        self._print(lambda: self._printer.lost(stream, 1, f"undecodable: {problem}"))

    def fault(self, error: Exception) -> None:
        self._warn(f"an internal error; please report it: {error!r}")

    def object_refused(self, object_id: str, code: str, why: str) -> None: ...

    def subscription_refused(self, code: str, text: str) -> None:
        self.problem = RefusedError(code, f"the relay refuses us: {text}")


async def listen(
    topic: TopicName,
    identity: Identity,
    printer: Printer | RatePrinter,
    shutdown: Shutdown,
    *,
    timeout_s: float,
    warn: Callable[[str], None],
) -> None:
    """Print `topic` until `shutdown`, or until the printer has had enough. Raises SernError.

    `timeout_s`: how long the relay, and from then on the topic, may take to appear; 0: for ever. As long as nothing is
    known of the relay, it has the time of a whole handshake, even where `timeout_s` is less.
    """
    _refuse_a_running_daemon(identity)
    listener = Listener(printer, warn)
    core = ClientCore(
        name=identity.name,
        boot=secrets.randbits(63),
        events=listener,
        link=identity.link,
        scheduler=identity.scheduler,
        now=clock.now(),
    )
    core.subscribe((re.escape(topic),), now=clock.now())
    reason = UNHEARD

    def note(text: str) -> None:
        nonlocal reason
        reason = text

    ctx: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    transport: RelayTransport | None = None
    try:
        transport = RelayTransport(
            ctx,
            core.link,
            identity.endpoint,
            identity.keys,
            identity.server_keys,
            heartbeat_timeout_s=identity.link.heartbeat_timeout_s,
            handshake_interval_s=identity.handshake_interval_s,
            random=Random(secrets.randbits(64)),
            on_reason=note,
        )
        began_s = clock.now()
        up_s: float | None = None
        while not (shutdown.requested or listener.done):
            await asyncio.sleep(_CHECK_S)
            if listener.problem is not None:
                raise listener.problem
            if listener.turns >= RIVAL_TURNS:
                raise SernError(
                    f"another program is connected to {identity.endpoint} as {identity.name}; "
                    "use a key of your own: sern keygen client NAME"
                )
            if core.link.established and up_s is None:
                up_s = clock.now()
            if not listener.seen:
                _check_patience(topic, identity, core, transport, reason, began_s, up_s, timeout_s)
            elif printer.tick():
                break
        listener.done = True
        await _leave(core, transport, listener)
    finally:
        if transport is not None:
            transport.close()
        ctx.term()


def _check_patience(
    topic: str,
    identity: Identity,
    core: ClientCore,
    transport: RelayTransport,
    reason: str,
    began_s: float,
    up_s: float | None,
    timeout_s: float,
) -> None:
    """Raises SernError when what is missing will not come, or has not come in time.

    The topic has its time from `up_s` on, when the relay was there: a long handshake takes nothing of it.
    """
    if transport.rebuilds and not core.link.established:
        raise SernError(f"{identity.endpoint}: {reason}")
    limit_s = timeout_s
    if up_s is None and reason == UNHEARD:  # a relay that is far away, or a busy machine: nothing says that it is gone
        limit_s = max(timeout_s, identity.handshake_interval_s)
    if not timeout_s or clock.now() - (began_s if up_s is None else up_s) < limit_s:
        return
    if not core.link.established:
        raise SernError(f"{identity.endpoint}: {reason} (waited {limit_s:g} s)")
    raise SernError(
        f"{topic} has not appeared at {core.link.peer} within {timeout_s:g} s: nobody publishes it "
        "(`sern topics` at the relay lists what there is)"
    )


async def _leave(core: ClientCore, transport: RelayTransport, listener: Listener) -> None:
    """Unsubscribe, or the relay would keep reliable messages for us and hold up their publishers meanwhile."""
    if not core.link.established:
        return
    core.subscribe((), now=clock.now())
    transport.pump.run()
    with suppress(TimeoutError):
        await asyncio.wait_for(listener.left.wait(), LEAVE_S)
    core.link.close("sern echo ends", now=clock.now())
    transport.pump.run()
    await asyncio.sleep(_CHECK_S)  # libzmq's thread takes it from here


def _refuse_a_running_daemon(identity: Identity) -> None:
    if identity.http is None:
        return
    url = f"http://{identity.http}"
    try:
        get_json(url, "/api/link", timeout_s=DAEMON_S)
    except SernError:
        return
    raise UsageError(
        f"{identity.name} is connected already: its daemon answers at {url}, and one name has one connection; "
        "make a key for yourself (sern keygen client NAME) and give it with --relay, --key and --server-key"
    )


# --- without a key: the values that a daemon has ----------------------------------------------------------------


def _values(api: str, topic: str) -> tuple[list[dict[str, Any]], dict[str, str], str]:
    """What the daemon has of `topic`, texts of definitions by their key, and what it means that there is nothing."""
    query = f"?topic={quote(topic, safe='')}"
    try:
        answer, nothing = get_json(api, f"/api/objects{query}"), "no topic {topic}"
    except NotFoundError:  # a client
        answer, nothing = get_json(api, f"/api/values{query}"), "no message of {topic} has passed this client"
    found = [item for item in answer["objects"] if is_stream(item) and item["attributes"]["topic"] == topic]
    return found, answer["definitions"], nothing.format(topic=topic)


async def poll(
    topic: str,
    api: str,
    printer: Printer,
    shutdown: Shutdown,
    decoder: Decoder,
    *,
    timeout_s: float,
    warn: Callable[[str], None],
) -> None:
    """Print the latest value of `topic` whenever the daemon at `api` has a newer one. Raises SernError."""
    shown: dict[str, int] = {}
    began_s = clock.now()
    warned = False
    while not shutdown.requested:
        found, definitions, nothing = await asyncio.to_thread(_values, api, topic)
        if not found and not shown and timeout_s and clock.now() - began_s > timeout_s:
            raise SernError(f"{api}: {nothing} within {timeout_s:g} s; `sern topics` lists what there is")
        if found and not shown and not warned and timeout_s and clock.now() - began_s > timeout_s:
            warned = all(item["value"] is None for item in found)
            if warned:
                warn(
                    f"{topic} of {found[0]['owner']} is announced, and the relay has no message of it: nothing is "
                    "published, or nobody takes it (`sern topics` marks that); a client has it sent: --relay"
                )
        for item in found:
            value = item["value"]
            if value is None or shown.get(item["id"]) == item["version"]:
                continue
            if "base64" not in value:
                raise SernError(
                    f"{topic}: a message has {value['bytes']} bytes, and {api} keeps only small ones; "
                    "connect as a client: --relay, --key and --server-key"
                )
            encoding = Encoding(item["attributes"]["encoding"])
            if item["id"] not in shown:
                decoder.prepare(topic, item["type"], definitions.get(item["definition_key"], ""), encoding)
            shown[item["id"]] = item["version"]
            comment = f"# {item['owner']} seq {item['seq']} latest value"
            if printer.write(comment, topic, item["type"], encoding, base64.b64decode(value["base64"])):
                return
        with_timeout = asyncio.ensure_future(shutdown.wait())
        await asyncio.wait([with_timeout], timeout=POLL_S)
        with_timeout.cancel()


# --- the command -----------------------------------------------------------------------------------------------


def _warn(text: str) -> None:
    print(f"sern echo: {text}", file=sys.stderr)


def run_echo(
    topic: str,
    *,
    config: Path | None = None,
    relay: str | None = None,
    key: Path | None = None,
    server_key: Path | None = None,
    name: str | None = None,
    api: str | None = None,
    count: int | None = None,
    raw: bool = False,
    full: bool = False,
    rate: bool = False,
    timeout_s: float = DEFAULT_TIMEOUT_S,
    out: TextIO | None = None,
) -> None:
    """Print messages until Ctrl-C, or `count` of them (with `rate`: lines). Raises SernError. Main thread only."""
    out = out or sys.stdout
    problem = name_problem(topic)
    if problem is not None:
        raise UsageError(f"topic {topic!r} {problem}")
    if sum(source is not None for source in (config, relay, api)) > 1:
        raise UsageError("give one place to listen at: --api URL, or --relay with its keys, or --config FILE")
    if relay is None and (key, server_key, name) != (None, None, None):
        raise UsageError("--key, --server-key and --name go with --relay")
    decoder = Decoder(raw=raw, full=full)
    if config is None and relay is None:
        if rate:
            raise UsageError(
                "--rate needs every message, and --api sees only the latest; connect as a client: --relay, --key and "
                "--server-key"
            )
        printer, address = Printer(decoder, out, count=count), checked_api(api or local_api())
        run(lambda shutdown: poll(topic, address, printer, shutdown, decoder, timeout_s=timeout_s, warn=_warn))
        return
    if config is not None:
        identity = identity_from_file(config)
    else:
        identity = identity_from_options(relay or "", key, server_key, name)
    shown = RatePrinter(out, count=count) if rate else Printer(decoder, out, count=count)
    # The transport logs what `listen` says in one line.
    logging.getLogger().addHandler(logging.NullHandler())
    run(lambda shutdown: listen(TopicName(topic), identity, shown, shutdown, timeout_s=timeout_s, warn=_warn))


def echo(
    topic: Annotated[str, typer.Argument(help="Global name of the topic, such as /jackal1/odom.")],
    relay: Annotated[str | None, typer.Option("--relay", help="The relay, such as tcp://relay.example:5555.")] = None,
    key: Annotated[Path | None, typer.Option("--key", help="Your own secret key file (NAME.key).")] = None,
    server_key: Annotated[Path | None, typer.Option("--server-key", help="The relay's public key file.")] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Your name, at a relay on this machine without keys.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="A client file to take name, relay and keys from.")
    ] = None,
    api: Annotated[
        str | None,
        typer.Option(
            "--api", help="Latest values, without a key, from a daemon's HTTP address [default: this machine's]."
        ),
    ] = None,
    count: Annotated[int | None, typer.Option("--count", "-n", min=1, help="End after so many messages.")] = None,
    raw: Annotated[bool, typer.Option("--raw", help="The bytes in hex, not decoded.")] = False,
    full: Annotated[bool, typer.Option("--full", help="Arrays and bytes in full length.")] = False,
    rate: Annotated[bool, typer.Option("--rate", help="Rate, bytes, ages and gaps once a second instead.")] = False,
    timeout_s: Annotated[
        float,
        typer.Option("--timeout", min=0, help="Seconds for the relay, and then the topic, to appear; 0: for ever."),
    ] = DEFAULT_TIMEOUT_S,
) -> None:
    """Print the messages of a topic as they pass.

    From the daemon on this machine its latest values, looked at twice a second; with --relay or --config every message,
    as a client of the relay with a key of its own, so access rules hold. Exit code 0 when ended by Ctrl-C or --count,
    1 when relay or topic could not be had or decoded, 2 for wrong usage or configuration.
    """
    try:
        run_echo(
            topic,
            config=config,
            relay=relay,
            key=key,
            server_key=server_key,
            name=name,
            api=api,
            count=count,
            raw=raw,
            full=full,
            rate=rate,
            timeout_s=timeout_s,
        )
    except BrokenPipeError:
        drop_output()
    except SernError as error:
        raise typer.Exit(say("sern echo", error)) from None
