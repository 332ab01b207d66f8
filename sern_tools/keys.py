"""`sern keys`: which keys there are and who uses them, taking one out, and going over to new ones.

Each command changes files, has the running daemon read them, and waits until the daemon says that they are in force.
One that is ended in the middle is given again, and goes on where it was. Exit codes: 0 done; 1 the daemon could not be
asked, or did not do it in time; 2 wrong usage, or a file that cannot be read or written.
"""

import difflib
import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from sern_core.vocabulary.errors import ConfigError, RefusedError, SernError, UsageError
from sern_core.vocabulary.names import client_name
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.client import ClientFile, load_client
from sern_runtime.config.key_changes import check_owner, revoke, revoked_at, take_in
from sern_runtime.config.keys import (
    NEXT_SUFFIX,
    PUBLIC_SUFFIX,
    KeyDirectory,
    KeyStatus,
    PublicKey,
    PublicKeys,
    SecretKey,
    fingerprint,
    generate,
    load_secret,
    utc,
    write_public,
    write_secret,
)
from sern_runtime.config.load import Loaded
from sern_runtime.config.relay import RelayFile, load_relay
from sern_runtime.config.yaml import read_document
from sern_runtime.whole_file import sync_directory
from sern_tools.api import get_json, say
from sern_tools.check import detect

PROGRAM: Final = "sern keys"
RELAY_FILE: Final = Path("/etc/sern/relay.yaml")
CLIENT_FILE: Final = Path("/etc/sern/client.yaml")
IN_FORCE_S: Final = 10.0
"""How long a daemon may take to do what it was told; it takes less than a second."""
TOLD_S: Final = 5.0
"""How long clients that are connected may take to say that they have a key for good."""
POLL_S: Final = 0.1
ROUTE: Final = "/api/keys"


@dataclass(frozen=True)
class Running:
    """A daemon of this machine that may be running: where it answers, and how a person reloads it."""

    api: str | None
    unit: str

    def view(self) -> dict[str, Any]:
        """What it says of its keys. SernError: it does not answer."""
        if self.api is None:
            raise SernError("http.listen is null, so a running daemon cannot be asked")
        return dict(get_json(self.api, ROUTE))

    @property
    def by_hand(self) -> str:
        """What a person does in place of this command."""
        return f"reload it with: sudo systemctl reload {self.unit}"

    def reload(self) -> dict[str, Any]:
        """Have it read its keys anew; what it said before. SernError where that is not possible."""
        try:
            view = self.view()
        except SernError as error:
            raise SernError(f"the files are changed, and no daemon was told: {error}; {self.by_hand}") from error
        pid = int(view["pid"])
        try:
            command = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            command = ""
        if "sern" not in command:
            raise SernError(f"process {pid}, of which {self.api} speaks, is not on this machine; {self.by_hand}")
        try:
            os.kill(pid, signal.SIGHUP)
        except (PermissionError, ProcessLookupError) as error:
            raise SernError(
                f"process {pid} cannot be told: {(error.strerror or '').lower()}; {self.by_hand}"
            ) from error
        return view

    def wait(self, done: Callable[[dict[str, Any]], bool], what: str, *, limit_s: float = IN_FORCE_S) -> dict[str, Any]:
        """Ask until it is so. SernError when it is not in time."""
        until_s = time.monotonic() + limit_s
        while True:
            view = self.view()
            if done(view):
                return view
            if time.monotonic() >= until_s:
                raise SernError(f"{what} is not in force after {limit_s:g} s; see the log of {self.unit}")
            time.sleep(POLL_S)


def running_relay(loaded: Loaded[RelayFile]) -> Running:
    """The daemon of a relay file."""
    return Running(_api(loaded.model.http.listen), "sern-relay")


def _running_client(loaded: Loaded[ClientFile]) -> Running:
    return Running(_api(loaded.model.http.listen), "sern-client")


def _api(listen: str | None) -> str | None:
    if listen is None:
        return None
    host, _, port = listen.rpartition(":")
    return f"http://{'127.0.0.1' if host in ('0.0.0.0', '[::]') else host}:{port}"


def clients_dir(loaded: Loaded[RelayFile]) -> Path:
    """The folder of client keys. ConfigError: this relay has none."""
    name = loaded.model.relay.clients_dir
    if name is None:
        raise ConfigError("the relay has no keys (insecure: true)", file=str(loaded.path))
    return loaded.resolve(name)


# --- list -----------------------------------------------------------------------------------------------------------


def listed(loaded: Loaded[RelayFile], *, at_s: float) -> dict[str, Any]:
    """Every key of relay and clients, and what the running relay says of them. Raises ConfigError."""
    directory = KeyDirectory(clients_dir(loaded))
    try:
        view, problem = running_relay(loaded).view(), ""
    except SernError as error:
        view, problem = {}, str(error)
    secret = _secret_file(loaded)
    coming = secret.with_suffix(NEXT_SUFFIX)
    rows = [
        _row(name, key, key.status(at_s).value, view)
        for name in directory.names
        for key in sorted(directory.keys_of(name), key=lambda key: key.not_after_s or float("inf"))
    ]
    rows += [_row(name, key, KeyStatus.REVOKED.value, view) for name, key in directory.revoked()]
    return {
        "relay": {
            "name": loaded.model.name,
            "fingerprint": fingerprint(load_secret(secret).public_key),
            "next": fingerprint(load_secret(coming).public_key) if coming.exists() else None,
        },
        "problem": problem,
        "clients": rows,
    }


def _row(name: ClientName, key: PublicKey, status: str, view: dict[str, Any]) -> dict[str, Any]:
    mark = fingerprint(key.key)
    seen = view.get("clients", {}).get(name, {})
    connected = None if not view else bool(seen.get("connected")) and seen.get("in_use") in (mark, None)
    return {
        "name": name,
        "fingerprint": mark,
        "status": status,
        "not_before": None if key.not_before_s is None else utc(key.not_before_s),
        "not_after": None if key.not_after_s is None else utc(key.not_after_s),
        "connected": connected if status != KeyStatus.REVOKED.value else (None if not view else False),
    }


def _show(found: dict[str, Any]) -> None:
    relay = found["relay"]
    coming = f", to come {relay['next']}" if relay["next"] else ""
    typer.echo(f"relay {relay['name']}  {relay['fingerprint']}{coming}")
    rows = [("client", "fingerprint", "status", "from", "until", "connected")]
    for row in found["clients"]:
        connected = {None: "?", True: "yes", False: "no"}[row["connected"]]
        status = row["status"].replace("_", " ")
        rows.append(
            (row["name"], row["fingerprint"], status, row["not_before"] or "", row["not_after"] or "", connected)
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for cells in rows if found["clients"] else ():
        typer.echo("  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip())
    if not found["clients"]:
        typer.echo("no client has a key")
    if found["problem"]:
        typer.echo(f"who is connected is not known: {found['problem']}", err=True)


# --- revoke ---------------------------------------------------------------------------------------------------------


def run_revoke(loaded: Loaded[RelayFile], name: str, *, at_s: float, out: Callable[[str], None]) -> None:
    """Take out every key of a client, and wait until the relay says that none holds. Raises SernError."""
    directory = clients_dir(loaded)
    client = client_name(name)
    known = KeyDirectory(directory)
    before = revoked_at(known, client)
    if client not in known.names and before is None:
        near = sorted(difflib.get_close_matches(client, known.names, n=3))
        hint = f"; did you mean {' or '.join(near)}?" if near else f"; there are: {', '.join(known.names) or 'none'}"
        raise UsageError(f"no client {client} has a key in {directory}{hint}")
    check_owner(directory)
    done = revoke(directory, client, at_s=at_s)
    if done.keys:
        out(f"revoked {', '.join(fingerprint(key.key) for key in done.keys)} of {client}; kept in {done.file}")
    else:
        out(f"{client} was revoked at {before}")
    relay = running_relay(loaded)
    began_s = time.monotonic()
    relay.reload()

    def out_of_it(view: dict[str, Any]) -> bool:
        seen = view["clients"].get(client, {})
        return not seen.get("valid") and not seen.get("connected")

    view = relay.wait(out_of_it, f"the revocation of {client}")
    out(f"the relay says that no key of {client} holds, after {time.monotonic() - began_s:.1f} s")
    reached = view.get("relays", {})
    told, away = ([name for name, up in reached.items() if up is state] for state in (True, False))
    if told:
        out(f"told to the relays that it is connected to: {', '.join(told)}")
    if away:
        out(f"not reached now, and told when they are: {', '.join(away)}")


# --- rotate ---------------------------------------------------------------------------------------------------------


def next_pair(secret: Path, *, out: Callable[[str], None]) -> SecretKey:
    """The pair to come beside `secret`: the one that an earlier run made, or a new one."""
    check_owner(secret)
    coming = secret.with_suffix(NEXT_SUFFIX)
    if coming.exists():
        pair = load_secret(coming)
        out(f"going on with {coming}: {fingerprint(pair.public_key)}")
        return pair
    pair = generate(load_secret(secret).name)
    write_secret(coming, pair)
    out(f"wrote {coming} (secret, mode 0600): {fingerprint(pair.public_key)}")
    return pair


def put_in_place(secret: Path, pair: SecretKey) -> None:
    """The pair to come becomes the pair. NAME.pub goes first: it is for people, and a second run writes it again."""
    try:
        write_public(
            secret.with_suffix(PUBLIC_SUFFIX), PublicKeys(pair.name, (PublicKey(pair.public_key),)), replace=True
        )
        secret.with_suffix(NEXT_SUFFIX).replace(secret)
        sync_directory(secret.parent)
    except OSError as error:
        raise ConfigError(f"can not be replaced: {error.strerror or error}", file=str(secret)) from error


def rotate_client(loaded: Loaded[ClientFile], *, out: Callable[[str], None], limit_s: float = 60.0) -> None:
    """Make a new pair, have the running client take it to the relay it is at and go over to it, and put it in place."""
    relays = loaded.model.all_relays
    name = relays[0].secret_key_file
    if any(relay.secret_key_file != name for relay in relays):
        raise ConfigError(
            "its relays have different secret_key_file; give one key to all of them", file=str(loaded.path)
        )
    if name is None:
        raise ConfigError("this client has no keys (insecure: true)", file=str(loaded.path))
    secret = loaded.resolve(name)
    pair = next_pair(secret, out=out)
    mark = fingerprint(pair.public_key)
    client = _running_client(loaded)
    again = f"the new pair waits in {secret.with_suffix(NEXT_SUFFIX)}: give the command again to go on"
    try:
        before = client.reload()["reloads"]

        def answered(view: dict[str, Any]) -> bool:
            return view["in_use"] == mark or (view["reloads"] != before and bool(view["problem"]))

        view = client.wait(answered, "the new key", limit_s=limit_s)
    except SernError as error:
        raise SernError(f"{error}; {again}") from error
    if view["in_use"] != mark:
        add = f"sern keys add {pair.name} -- '{pair.public_key}'"  # it may begin with a hyphen
        raise SernError(f"{view['problem']}. On the relay: {add}. Here {again}")
    put_in_place(secret, pair)
    client.reload()
    out(f"{pair.name} uses {mark} now; the relay lets the old key go when its time is over")
    if len(relays) > 1:  # they have not met it
        out(f"on each of its other relays, or it is not let in there: sern keys add {pair.name} -- '{pair.public_key}'")


def rotate_relay(loaded: Loaded[RelayFile], *, switch: bool, force: bool, out: Callable[[str], None]) -> None:
    """Make the pair to come and have clients told of it; with `switch` go over to it, once they all know."""
    secret = _secret_file(loaded)
    coming = secret.with_suffix(NEXT_SUFFIX)
    relay = running_relay(loaded)
    if switch and not coming.exists():
        raise UsageError(f"there is no {coming}; make it with sern keys rotate, and wait until all clients know it")
    pair = next_pair(secret, out=out)
    mark = fingerprint(pair.public_key)
    relay.reload()
    view = relay.wait(lambda view: mark in (view["relay"]["next"], view["relay"]["in_use"]), "the key to come")
    until_s = time.monotonic() + TOLD_S
    while _missing(view, mark, connected=True) and time.monotonic() < until_s:
        time.sleep(POLL_S)
        view = relay.view()
    missing = _missing(view, mark)
    for line in missing.values():
        out(line)
    if not switch:
        out(f"{len(view['clients']) - len(missing)} of {len(view['clients'])} clients accept {mark}; "
            "then: sern keys rotate --switch")  # fmt: skip
        return
    if missing and not force:
        raise SernError(
            f"not done: {', '.join(missing)} would be locked out until its relay.pub is replaced; wait for it, give it "
            f"{secret.with_suffix(PUBLIC_SUFFIX).name} by hand, or add --force"
        )
    put_in_place(secret, pair)
    relay.reload()
    relay.wait(lambda view: view["relay"]["in_use"] == mark, "the new key")
    out(f"the relay proves itself with {mark} now; keep a new backup of {secret}")


def _missing(view: dict[str, Any], mark: str, *, connected: bool = False) -> dict[str, str]:
    """The clients that would not know a relay with this key, and a line for each; `connected`: of those alone."""
    found = {}
    for name, seen in view["clients"].items():
        if not seen["valid"] or (connected and not seen["connected"]):
            continue
        if mark not in seen["accepts"]:
            found[name] = f"{name} does not know it: " + (
                "it is connected" if seen["connected"] else "it is not connected"
            )
        elif not seen["kept"]:
            found[name] = f"{name} knows it until it is started again: it may not write its relay's key file"
    return found


def _secret_file(loaded: Loaded[RelayFile]) -> Path:
    name = loaded.model.relay.secret_key_file
    if name is None:
        raise ConfigError("the relay has no keys (insecure: true)", file=str(loaded.path))
    return loaded.resolve(name)


# --- commands -------------------------------------------------------------------------------------------------------

app = typer.Typer(help="List, revoke and rotate keys.", no_args_is_help=True)

_Relay = Annotated[Path, typer.Option("--config", "-c", help="The relay's file.")]


def reported(program: str, run: Callable[[], None]) -> None:
    """Run a command, and say in one line what went wrong."""
    try:
        run()
    except SernError as error:
        raise typer.Exit(say(program, error)) from error


@app.command("list")
def list_command(
    config: _Relay = RELAY_FILE, as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False
) -> None:
    """Show every client's keys, when they hold, and who is connected; on the relay."""

    def run() -> None:
        found = listed(load_relay(config), at_s=time.time())
        if as_json:
            typer.echo(json.dumps(found, indent=1))
        else:
            _show(found)

    reported(PROGRAM, run)


@app.command("revoke")
def revoke_command(name: Annotated[str, typer.Argument(help="The client.")], config: _Relay = RELAY_FILE) -> None:
    """Take out every key of a client, at once and for good; on the relay."""
    reported(PROGRAM, lambda: run_revoke(load_relay(config), name, at_s=time.time(), out=typer.echo))


@app.command("add")
def add_command(
    name: Annotated[str, typer.Argument(help="The client.")],
    key: Annotated[str, typer.Argument(help="Its further public key: -- 'KEY', as it may begin with a hyphen.")],
    config: _Relay = RELAY_FILE,
) -> None:
    """Let a client have a further public key; the one that it has ends after relay.key_overlap_s. On the relay."""

    def run() -> None:
        loaded = load_relay(config)
        directory, client, at_s = clients_dir(loaded), client_name(name), time.time()
        valid = [each for each in KeyDirectory(directory).keys_of(client) if each.status(at_s) is KeyStatus.VALID]
        if not valid:
            raise UsageError(f"{client} has no key in {directory} that holds; use sern enroll open {client}")
        newest = max(valid, key=lambda each: (each.not_after_s or float("inf"), each.key != key))
        check_owner(directory)
        try:
            take_in(directory, client, newest.key, key, at_s=at_s, overlap_s=loaded.model.relay.key_overlap_s)
        except RefusedError as error:
            raise UsageError(str(error)) from error
        typer.echo(f"{client} has {fingerprint(key)} beside {fingerprint(newest.key)}")
        relay = running_relay(loaded)
        relay.reload()
        relay.wait(lambda view: fingerprint(key) in view["clients"].get(client, {}).get("valid", ()), "the key")

    reported(PROGRAM, run)


@app.command("rotate")
def rotate_command(
    config: Annotated[Path | None, typer.Option("--config", "-c", help="The client's or the relay's file.")] = None,
    switch: Annotated[bool, typer.Option("--switch", help="Relay: go over to the key that clients know.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Relay: also if some clients do not know it.")] = False,
) -> None:
    """Go over to a new key, without an outage: of a client in one step, of the relay in two."""

    def run() -> None:
        path = config or (CLIENT_FILE if CLIENT_FILE.exists() or not RELAY_FILE.exists() else RELAY_FILE)
        if detect(read_document(path)) is RelayFile:
            rotate_relay(load_relay(path), switch=switch, force=force, out=typer.echo)
        elif switch or force:
            raise UsageError(f"--switch and --force are for a relay, and {path} is none's")
        else:
            rotate_client(load_client(path), out=typer.echo)

    reported(PROGRAM, run)
