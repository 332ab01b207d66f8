"""`sern enroll`: a client gets its keys and the relay's by a one-time code, and no file is copied by hand.

`sern enroll open NAME` on the relay shows a code and listens; `sern enroll ask RELAY CODE` on the client makes the key
pair there and asks; the operator compares the fingerprint that both show, and accepts. Exit codes: 0 done; 1 it was not
accepted, is over, or the other end could not be had; 2 wrong usage, or a file that cannot be read or written.
"""

import asyncio
import os
import re
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final

import typer

from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_core.vocabulary.names import client_name
from sern_core.vocabulary.types import ClientName
from sern_relay.keyring import OwnKeys
from sern_runtime import clock
from sern_runtime.config.key_changes import add_client, check_owner
from sern_runtime.config.keys import (
    PUBLIC_SUFFIX,
    SECRET_SUFFIX,
    KeyDirectory,
    PublicKey,
    PublicKeys,
    fingerprint,
    generate,
    load_public,
    write_public,
    write_secret,
)
from sern_runtime.config.load import Loaded
from sern_runtime.config.relay import RelayFile, load_relay
from sern_runtime.enrolment import (
    DONE_S,
    MAX_CLOCK_DIFFERENCE_S,
    EnrolmentClient,
    EnrolmentServer,
    Offer,
    State,
    new_code,
)
from sern_runtime.whole_file import sync_directory
from sern_tools.keys import RELAY_FILE, clients_dir, reported, running_relay

PROGRAM: Final = "sern enroll"
LISTEN: Final = "tcp://0.0.0.0:5556"
LOOK_S: Final = 0.2
TELL_S: Final = 3.0
"""How long the relay waits for a client to hear that it was not accepted."""
MAX_VALID_S: Final = 86_400.0
_DURATION: Final = re.compile(r"(\d+)\s*(s|m|h)?")
_UNITS: Final = {"s": 1.0, "m": 60.0, "h": 3600.0, None: 1.0}

Say = Callable[[str], None]


def duration_s(text: str) -> float:
    """`10m`, `90s`, `2h` or a number of seconds. UsageError otherwise."""
    found = _DURATION.fullmatch(text.strip())
    seconds = 0.0 if found is None else int(found[1]) * _UNITS[found[2]]
    if not 0 < seconds <= MAX_VALID_S:
        raise UsageError(f"--valid {text!r} is no time: write for example 10m, 90s or 2h, at most 24h")
    return seconds


# --- the relay's end -------------------------------------------------------------------------------------------------


class Opened:
    """One enrolment at the relay: what it says, and where its operator answers."""

    def __init__(self, loaded: Loaded[RelayFile], name: str, *, replacing: bool, say: Say) -> None:
        self.name = client_name(name)
        self.loaded = loaded
        self.directory = clients_dir(loaded)
        self._replacing = replacing
        self._say = say
        self.asking = self.directory / f".enrolling-{self.name}"
        self._accepting = accepting(self.asking)
        known = KeyDirectory(self.directory)
        check_owner(self.directory)
        if known.keys_of(self.name) and not replacing:
            raise ConfigError(f"{self.name} has a key already; --replace revokes it", file=str(self.directory))
        self._forget()

    def offer(self) -> Offer:
        """What the client gets. ConfigError: the relay's own key cannot be read."""
        file = self.loaded.model.relay.secret_key_file
        if file is None:
            raise ConfigError("the relay has no keys (insecure: true)", file=str(self.loaded.path))
        own = OwnKeys.read(self.loaded.resolve(file))
        return Offer(self.name, self.loaded.model.name, own.public)

    def _forget(self) -> None:
        for file in (self.asking, self._accepting):
            file.unlink(missing_ok=True)

    async def run(self, server: EnrolmentServer, *, interactive: bool) -> None:
        """Wait until it is over. Raises SernError when no client was enrolled."""
        try:
            await self._until(server, lambda: server.state is not State.OPEN)
            if server.key is not None and not server.burnt:
                await self._ask_operator(server, server.key, interactive=interactive)
            if server.state is not State.ACCEPTED:
                await self._until(server, lambda: server.told, limit_s=TELL_S if server.key else 0.0)
                raise SernError(f"{self.name} is not enrolled: {server.burnt or 'the operator did not accept it'}")
            await self._until(server, lambda: server.done, limit_s=DONE_S)
            if not server.done:
                raise SernError(
                    f"{self.name} has not said that it has its files; if it has not, open once more with --replace"
                )
            self._say(f"{self.name} has its files")
        finally:
            self._forget()
            if server.told:  # what was said last is read, and then the client goes
                await self._until(server, lambda: not len(server.connections), limit_s=TELL_S)
            strangers = server.strangers()
            if strangers:
                self._say(strangers)

    async def _until(self, server: EnrolmentServer, done: Callable[[], bool], *, limit_s: float | None = None) -> None:
        until_s = float("inf") if limit_s is None else clock.now() + limit_s
        while not done() and clock.now() < until_s:
            server.look()
            server.changed.clear()
            if done():
                break
            with suppress(TimeoutError):
                await asyncio.wait_for(server.changed.wait(), LOOK_S)

    async def _ask_operator(self, server: EnrolmentServer, key: str, *, interactive: bool) -> None:
        mark = fingerprint(key)
        self.asking.write_text(mark)
        self._say(f"{self.name} asks from {server.source}, fingerprint {mark}")
        lines: list[str] = []
        if interactive:
            self._say("the same as the client shows? accept? [y/N]")
            asyncio.get_running_loop().add_reader(sys.stdin.fileno(), lambda: lines.append(sys.stdin.readline()))
        else:
            self._say(f"if it is what the client shows: sern enroll accept {self.name} {mark}")
        try:
            await self._until(
                server, lambda: bool(lines) or self._accepting.exists() or server.state is not State.WAITING
            )  # fmt: skip
        finally:
            if interactive:
                asyncio.get_running_loop().remove_reader(sys.stdin.fileno())
        if server.state is not State.WAITING:
            return
        answered = "" if lines else self._accepting.read_text().strip()
        self._forget()
        yes = lines[0].strip().lower() in ("y", "yes") if lines else answered == mark
        if not yes:
            server.refuse("the relay's operator did not accept it")
            return
        try:
            keys = PublicKeys(self.name, (PublicKey(key),))
            file = await asyncio.to_thread(
                add_client, self.directory, keys, replacing=self._replacing, at_s=time.time()
            )  # fmt: skip
        except ConfigError:
            server.refuse("the relay could not write the key; see what it says there")
            await self._until(server, lambda: server.told, limit_s=TELL_S)
            raise
        self._say(f"wrote {file}")
        await asyncio.to_thread(self._put_in_force, mark)
        server.accept()

    def _put_in_force(self, mark: str) -> None:
        """Have the running relay know the key; where none runs, the next one does."""
        relay = running_relay(self.loaded)
        try:
            relay.reload()
            relay.wait(lambda view: mark in view["clients"].get(self.name, {}).get("valid", ()), "the new key")
        except SernError as error:
            self._say(f"warning: {error}")
        for warning in load_relay(self.loaded.path).warnings:
            if f"client {self.name}:" in warning:
                self._say(f"warning: {warning}")


def accepting(asking: Path) -> Path:
    """The file by which `sern enroll accept` answers the process that listens."""
    return asking.with_name(f"{asking.name}.accepted")


async def open_enrolment(
    loaded: Loaded[RelayFile],
    name: str,
    *,
    listen: str = LISTEN,
    valid_s: float = 600.0,
    replacing: bool = False,
    interactive: bool = False,
    say: Say,
) -> None:
    """Show a code, and enrol one client with it. Raises SernError when none was."""
    opened = Opened(loaded, name, replacing=replacing, say=say)
    code = new_code()
    server = EnrolmentServer(code, opened.offer(), listen, valid_s=valid_s)
    try:
        port = server.endpoint.rpartition(":")[2]
        until = time.strftime("%H:%M:%S", time.localtime(time.time() + valid_s))
        say(f"code {code}, good once, until {until}; listening on {server.endpoint}")
        say(f"on {name}: sern enroll ask tcp://{_shown_host(server.endpoint)}:{port} {code} --out /etc/sern")
        await opened.run(server, interactive=interactive)
    finally:
        server.close()


def _shown_host(endpoint: str) -> str:
    host = endpoint.removeprefix("tcp://").rpartition(":")[0]
    return "RELAY" if host in ("0.0.0.0", "[::]", "*") else host


def run_accept(loaded: Loaded[RelayFile], name: str, mark: str, *, say: Say) -> None:
    """Answer the enrolment that listens. Raises SernError when it does not ask for that."""
    client = client_name(name)
    asking = clients_dir(loaded) / f".enrolling-{client}"
    try:
        asked = asking.read_text().strip()
    except FileNotFoundError:
        raise UsageError(
            f"nobody asks as {client} now; is sern enroll open {client} running, and has it asked?"
        ) from None
    except OSError as error:
        raise ConfigError(f"can not be read: {error.strerror or error}", file=str(asking)) from error
    if asked != mark.strip().lower():
        raise UsageError(f"{client} asks with the fingerprint {asked}, and not with {mark}: it is not accepted")
    try:
        accepting(asking).write_text(asked)
    except OSError as error:
        raise ConfigError(f"can not be written: {error.strerror or error}", file=str(asking)) from error
    until_s = time.monotonic() + DONE_S
    while asking.exists():
        if time.monotonic() >= until_s:
            raise SernError(f"no sern enroll open took the answer within {DONE_S:g} s; is it still running?")
        time.sleep(LOOK_S)
    say(f"answered; sern enroll open says what became of {client}")


# --- the client's end ------------------------------------------------------------------------------------------------


class Written:
    """The files of a client to be: the secret key lies beside its place until the relay has accepted the public one."""

    def __init__(self, out: Path, offer: Offer, *, replacing: bool) -> None:
        self.secret = out / f"{offer.name}{SECRET_SUFFIX}"
        self.public = out / f"{offer.name}{PUBLIC_SUFFIX}"
        self.relay = out / f"{offer.relay}{PUBLIC_SUFFIX}"
        self._offer = offer
        self._waiting = out / f".{offer.name}.enrolling{SECRET_SUFFIX}"
        for path in () if replacing else (self.secret, self.public):
            if path.exists() or path.is_symlink():
                raise ConfigError("exists already; --replace replaces it", file=str(path))
        if not replacing and self.relay.exists() and not self._same_relay():
            raise ConfigError("exists already, and holds other keys; --replace replaces it", file=str(self.relay))
        self.pair = generate(offer.name)
        write_secret(self._waiting, self.pair, replace=True)

    def _same_relay(self) -> bool:
        known = load_public(self.relay)
        return {key.key for key in known.keys} == set(self._offer.relay_keys)

    def put_in_place(self) -> None:
        """All of them, the secret last: with it there are the others."""
        relay = PublicKeys(self._offer.relay, tuple(map(PublicKey, self._offer.relay_keys)))
        write_public(self.relay, relay, replace=True)
        own = PublicKeys(self._offer.name, (PublicKey(self.pair.public_key),))
        write_public(self.public, own, replace=True)
        try:
            self._waiting.replace(self.secret)
            sync_directory(self.secret.parent)
        except OSError as error:
            raise ConfigError(f"can not be written: {error.strerror or error}", file=str(self.secret)) from error

    def forget(self) -> None:
        self._waiting.unlink(missing_ok=True)


async def ask_enrolment(endpoint: str, code: str, out: Path, *, replacing: bool = False, say: Say) -> None:
    """Get keys by a code into the folder `out`. Raises SernError; then nothing there has changed."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"can not be made: {error.strerror or error}", file=str(out)) from error
    check_owner(out)
    if not os.access(out, os.W_OK):
        raise ConfigError("may not be written by this user; use sudo -u sern", file=str(out))
    client = EnrolmentClient(endpoint, code)
    written: Written | None = None
    try:
        offer, ahead_s = await client.offer()
        if abs(ahead_s) > MAX_CLOCK_DIFFERENCE_S:
            how = "ahead of" if ahead_s > 0 else "behind"
            say(f"warning: this machine's clock is {abs(ahead_s):.0f} s {how} the relay's")
        written = Written(out, offer, replacing=replacing)
        mark = fingerprint(written.pair.public_key)

        def told() -> None:
            say(f"{offer.name} asks relay {offer.relay}, fingerprint {mark}")
            say("waiting for the relay's operator, who sees the same fingerprint")

        await client.bring(written.pair.public_key, told=told)
        written.put_in_place()
        await client.finish(written.pair.public_key)
        say(f"wrote {written.secret} (secret, mode 0600), {written.public} and {written.relay}")
        say(_advice(offer.name, written))
    finally:
        if written is not None:
            written.forget()
        client.close()


def _advice(name: ClientName, written: Written) -> str:
    files = f"server_key_file: {written.relay.name}, secret_key_file: {written.secret.name}"
    return f"in client.yaml: client: {{name: {name}}}, relay: {{{files}}}"


# --- commands --------------------------------------------------------------------------------------------------------

app = typer.Typer(help="Let a new client in by a one-time code.", no_args_is_help=True)

_Config = Annotated[Path, typer.Option("--config", "-c", help="The relay's file.")]
_Name = Annotated[str, typer.Argument(help="The client: a lower-case letter, then up to 62 of a-z, 0-9, '_'.")]


@app.command("open")
def open_command(
    name: _Name,
    config: _Config = RELAY_FILE,
    valid: Annotated[str, typer.Option("--valid", help="How long the code is good.")] = "10m",
    listen: Annotated[str, typer.Option("--listen", help="Where clients ask; port * is any free one.")] = LISTEN,
    replace: Annotated[bool, typer.Option("--replace", help="Revoke the keys that the client has.")] = False,
) -> None:
    """Show a code and wait for the client that has it; on the relay."""

    def run() -> None:
        asyncio.run(
            open_enrolment(
                load_relay(config),
                name,
                listen=listen,
                valid_s=duration_s(valid),
                replacing=replace,
                interactive=sys.stdin.isatty(),
                say=typer.echo,
            )
        )

    _interruptible(run)


@app.command("accept")
def accept_command(
    name: _Name,
    mark: Annotated[str, typer.Argument(metavar="FINGERPRINT", help="What the client shows.")],
    config: _Config = RELAY_FILE,
) -> None:
    """Accept the client that asks, where sern enroll open has no terminal; on the relay."""
    reported(PROGRAM, lambda: run_accept(load_relay(config), name, mark, say=typer.echo))


@app.command("ask")
def ask_command(
    relay: Annotated[str, typer.Argument(help="Where sern enroll open listens: tcp://RELAY:5556.")],
    code: Annotated[str, typer.Argument(help="The code that it shows.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the three files; made if it is not there.")] = Path(),
    replace: Annotated[bool, typer.Option("--replace", help="Replace files that exist.")] = False,
) -> None:
    """Get keys by a code, and hand over the public one; on the client."""
    _interruptible(lambda: asyncio.run(ask_enrolment(relay, code, out, replacing=replace, say=typer.echo)))


def _interruptible(run: Callable[[], None]) -> None:
    """Ctrl-C is an end, not a traceback."""
    try:
        reported(PROGRAM, run)
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
