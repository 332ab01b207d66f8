"""`sern check FILE`: is this relay, client or key file right? Nothing is connected to or changed: of a client's relay
only the name is looked up."""

import asyncio
import difflib
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sern_client.relay_name import UnresolvedError, name_in, resolve
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import ClientName
from sern_runtime.config import keys
from sern_runtime.config.base import FileModel
from sern_runtime.config.client import ClientFile
from sern_runtime.config.endpoints import installing
from sern_runtime.config.fabric import FabricSection
from sern_runtime.config.load import Checked, Loaded, check_document
from sern_runtime.config.relay import RelayFile
from sern_runtime.config.yaml import Document, read_document

EXIT_OK: Final = 0
EXIT_USER_ERROR: Final = 2
RESOLVE_S: Final = 5.0
"""How long the resolver is waited for."""
_KEY_FILES: Final[dict[str, type[FileModel]]] = {"public": keys.PublicKeyFile, "secret": keys.SecretKeyFile}


def run_check(path: Path, *, out: Console | None = None, err: Console | None = None) -> int:
    """Check the file at `path` and the files it names; print a summary, or one line an error. 0 if right, else 2."""
    out = out or Console(highlight=False)
    err = err or Console(stderr=True, highlight=False)
    try:
        document = read_document(path)
        model = detect(document)
        checked: Checked[FileModel] = check_document(document, path, model, files=True)
    except ConfigError as error:
        _lines(err, [str(error)])
        return EXIT_USER_ERROR
    if checked.loaded is None:
        _lines(err, [str(error) for error in checked.errors])
        return EXIT_USER_ERROR
    loaded = checked.loaded
    _summary(out, loaded)
    # Below the tables, which may be longer than a terminal.
    _lines(err, [f"warning: {text}" for text in _warnings(loaded, document)])
    _lines(out, [f"{loaded.path}: right"])
    return EXIT_OK


def _warnings(loaded: Loaded[FileModel], document: Document) -> Iterator[str]:
    """What is wrong in all likelihood, and no error: the file may be for another machine, or a name be made later."""
    model, path = loaded.model, loaded.path
    if isinstance(model, keys.SecretKeyFile) and (open_to_others := keys.secret_warning(path)):
        yield open_to_others
    if isinstance(model, (keys.PublicKeyFile, keys.SecretKeyFile)) and (
        odd := keys.misnamed(path, ClientName(model.name))
    ):
        yield odd
    if isinstance(model, keys.PublicKeyFile) and (lapse := keys.load_public(path).lapse(time.time())):
        yield f"{path} {lapse}"
    yield from loaded.warnings
    for index, relay in enumerate(model.all_relays if isinstance(model, ClientFile) else ()):
        if problem := _unresolved(relay.endpoint):
            loc = ("relay",) if document.root.child("relay") is not None else ("relays", index)
            yield str(document.error((*loc, "endpoint"), problem))


def _unresolved(endpoint: str) -> str | None:
    named = name_in(endpoint)
    if named is None:
        return None

    async def ask() -> None:
        await asyncio.wait_for(resolve(*named), RESOLVE_S)

    try:
        asyncio.run(ask())
    except TimeoutError:
        why = f"no answer within {RESOLVE_S:g} s"
    except UnresolvedError as error:
        why = str(error)
    else:
        return None
    return f"{named[0]} does not resolve on this machine now: {why}"


def detect(document: Document) -> type[FileModel]:
    """What kind of file this is, by its keys; ConfigError when it is none of ours."""
    data = document.data if isinstance(document.data, dict) else {}
    if "sern_key" in data:
        kind = _KEY_FILES.get(str(data["sern_key"]))
        if kind is None:
            raise document.error(("sern_key",), f"is not accepted as it is; accepted: {', '.join(_KEY_FILES)}")
        return kind
    if "grid" in data and not data.keys() & {"client", "relay"}:
        try:
            from sern_runtime.config.navigation import NavigationFile
        except ImportError as error:  # scipy, which others need not have
            package = installing("'sern[twin]'")
            problem = f"is a navigation file, and to read one needs more packages: {package} ({error})"
            raise document.error((), problem) from None
        return NavigationFile
    # A client file has a section `relay` too: its connection to the relay.
    if "client" in data or "endpoint" in data:
        return ClientFile
    if "relay" in data:
        return RelayFile
    words = ("client", "endpoint", "relay", "sern_key")
    close = [word for key in data for word in difflib.get_close_matches(key, words, n=1)]
    hint = f" (did you mean {close[0]}?)" if close else ""
    kinds = "client file (client, relay, endpoint), relay file (relay), navigation file (grid) or key file"
    raise document.error((), f"is no {kinds}{hint}")


def _lines(console: Console, lines: Iterable[str]) -> None:
    for line in lines:
        console.print(Text(line), soft_wrap=True)


def _summary(out: Console, loaded: Loaded[FileModel]) -> None:
    model = loaded.model
    if isinstance(model, ClientFile):
        _client_summary(out, model)
    elif isinstance(model, RelayFile):
        _relay_summary(out, model)
    elif isinstance(model, keys.PublicKeyFile):
        _lines(out, [f"public key file of {model.name}, {len(model.keys)} key(s)"])
    elif isinstance(model, keys.SecretKeyFile):
        _lines(out, [f"secret key file of {model.name}"])
    elif "grid" in type(model).model_fields:
        kinds = " and ".join(endpoint.kind for endpoint in model.endpoints)  # type: ignore[attr-defined]
        _lines(out, [f"navigation at endpoint {kinds}"])


def _table(*titles: str) -> Table:
    """Patterns are shown whole: a long one goes on in the next line."""
    table = Table(box=None, pad_edge=False)
    for title in titles:
        table.add_column(title, overflow="fold")
    return table


def _client_summary(out: Console, model: ClientFile) -> None:
    _lines(
        out,
        [
            f"client {model.name}, namespace {model.namespace}",
            *(
                f"relay {relay.endpoint} ({'no encryption' if relay.insecure else 'CURVE'})"
                for relay in model.all_relays
            ),
            *(f"endpoint {endpoint.kind}" for endpoint in model.endpoints),
            f"discovery {model.discovery.mode}",
            f"scheduler {model.scheduler.ordering}, window {model.link.window.algorithm}",
        ],
    )
    table = _table("#", "match", "class", "direction", "reliability", "lifespan s", "rate Hz")
    for index, rule in enumerate(model.topics):
        lifespan = "for ever" if rule.lifespan_s is None else str(rule.lifespan_s)
        rate = "" if rule.max_rate_hz is None else f"{rule.max_rate_hz:g}"
        cells = (str(index), rule.match, rule.priority, rule.direction, rule.reliability, lifespan, rate)
        table.add_row(*(Text(cell) for cell in cells))
    if model.topics:
        out.print(table)
    _lines(out, [f"subscribes to {pattern}" for pattern in model.subscribe_patterns()])


def _fabric_summary(fabric: FabricSection | None) -> Iterator[str]:
    if fabric is None:
        return
    who = "anyone on this machine" if fabric.relays is None else ", ".join(fabric.relays)
    yield f"fabric with {who} ({'no encryption' if fabric.certificates is None else 'TLS'})"
    yield from (f"fabric listens on {locator}" for locator in fabric.listen)
    yield from (f"fabric connects to {locator}" for locator in fabric.peers)


def _relay_summary(out: Console, model: RelayFile) -> None:
    safety = "no encryption" if model.relay.insecure else "CURVE"
    _lines(
        out,
        [
            f"relay {model.name}",
            *(f"listens on {endpoint} ({safety})" for endpoint in model.relay.listen),
            *_fabric_summary(model.fabric),
            f"http {model.http.listen or 'off'}",
        ],
    )
    table = _table("#", "client", "may publish", "may subscribe")
    for index, rule in enumerate(model.access):
        cells = (str(index), rule.client, " ".join(rule.publish), " ".join(rule.subscribe))
        table.add_row(*(Text(cell) for cell in cells))
    if model.access:
        out.print(table)
    else:
        _lines(out, ["no access rules: nobody may do anything"])
    _lines(out, [f"feed role {role.name} on {role.publish_endpoint}" for role in model.feed.roles])


app = typer.Typer(help="Check a relay, client or key file without starting anything.")


@app.callback(invoke_without_command=True)
def check_command(file: Annotated[Path, typer.Argument(help="The file to check.")]) -> None:
    """Check FILE and the files it names. Exit code 0 when it is right, 2 when it is not."""
    raise typer.Exit(run_check(file))


if __name__ == "__main__":
    app()
