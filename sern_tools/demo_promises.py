"""What the demos of twin and navigation share: promises that were kept or broken, their page, and how a demo ends."""

import asyncio
import base64
import html
import json
from collections.abc import Callable, Coroutine, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn, Protocol, TypeVar

import typer
from rich.console import Console
from rich.table import Table

from sern_core.vocabulary.errors import SernError
from sern_tools.demo import EXIT_BROKEN, EXIT_ERROR, EXIT_INTERRUPTED, EXIT_OK

_STYLE: Final = (
    "body{font:15px system-ui,sans-serif;max-width:62em;margin:2em auto;padding:0 1em}img{max-width:100%}"
    "td,th{padding:.25em .8em;text-align:left;border-bottom:1px solid #ddd}.broken td:last-child{color:#c00;"
    "font-weight:bold}.kept td:last-child{color:#1a7f37}"
)


class Verdict(NamedTuple):
    """A promise, what was found, and whether that keeps it."""

    name: str
    found: str
    wanted: str
    kept: bool


class Judged(Protocol):
    """The report of a demo."""

    @property
    def ok(self) -> bool:
        """Whether every promise was kept."""
        ...


R = TypeVar("R", bound=Judged)


def show(verdicts: Sequence[Verdict], console: Console) -> None:
    table = Table("promise", "found", "wanted", "")
    for verdict in verdicts:
        table.add_row(verdict.name, verdict.found, verdict.wanted, "kept" if verdict.kept else "[red]BROKEN")
    console.print(table)


def page(
    title: str, command: str, verdicts: Sequence[Verdict], picture: bytes | None, *, shows: str, more: str = ""
) -> str:
    """An HTML page. `shows`: what is on the picture; `more`: HTML before the table."""
    rows = "".join(
        f"<tr class='{'kept' if verdict.kept else 'broken'}'><td>{html.escape(verdict.name)}</td>"
        f"<td>{html.escape(verdict.found)}</td><td>{html.escape(verdict.wanted)}</td>"
        f"<td>{'kept' if verdict.kept else 'broken'}</td></tr>"
        for verdict in verdicts
    )
    image = (
        "<p>No plots: matplotlib is not installed.</p>"
        if picture is None
        else f"<img alt='{html.escape(shows)}' src='data:image/png;base64,{base64.b64encode(picture).decode()}'>"
    )
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{title}</title><style>{_STYLE}</style>"
        f"<h1>{title}</h1><p><code>{html.escape(command)}</code></p>{more}"
        f"<table><tr><th>promise<th>found<th>wanted<th></tr>{rows}</table>{image}</html>\n"
    )


def write(
    out: Path, name: str, content: dict[str, Any], plot: Callable[[], bytes], html_of: Callable[[bytes | None], str]
) -> list[Path]:
    """NAME.json and NAME.html, and NAME.png where matplotlib is."""
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / f"{name}.json", out / f"{name}.html"]
    picture = plot() if find_spec("matplotlib") is not None else None
    paths[0].write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    paths[1].write_text(html_of(picture), encoding="utf-8")
    if picture is not None:
        paths.append(out / f"{name}.png")
        paths[2].write_bytes(picture)
    return paths


def conclude(
    program: str,
    run: Callable[[Console], Coroutine[Any, Any, R]],
    show: Callable[[R, Console], None],
    write: Callable[[R], list[Path]],
    *,
    packages: str = "",
) -> NoReturn:
    """Run a demo, show and write its report, and end the program with the exit status that says how it went.

    `packages`: what to install where one of its imports is missing.
    """
    console = Console()
    try:
        report = asyncio.run(run(console))
        show(report, console)
        for path in write(report):
            console.print(f"wrote {path}", highlight=False, soft_wrap=True)
        code = EXIT_OK if report.ok else EXIT_BROKEN
    except (SernError, OSError, ImportError) as error:
        problem = f"needs more packages: {packages} ({error})" if isinstance(error, ImportError) else str(error)
        Console(stderr=True).print(f"{program}: {problem}", highlight=False, markup=False, soft_wrap=True)
        code = EXIT_ERROR
    except (asyncio.CancelledError, KeyboardInterrupt):
        console.print("interrupted; everything was stopped")
        code = EXIT_INTERRUPTED
    raise typer.Exit(code)
