"""Writes the report: one page of HTML that needs nothing beside it, and the same as PDF."""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from benchmarks.paper import errata
from benchmarks.paper.claims import Figures, claims
from benchmarks.paper.pictures import pictures
from benchmarks.paper.running import Result, machine
from benchmarks.paper.tables import sections
from sern_core.vocabulary.errors import ConfigError, SernError
from sern_tools.checkout import commit

BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome")
PRINT_S: Final = 120.0


def html(results: Sequence[Result], folder: Path, *, quick: bool) -> str:
    """The whole page."""
    figures = Figures(results)
    drawn, not_drawn = {}, ""
    try:
        drawn = dict(pictures(figures))
    except ConfigError as error:
        not_drawn = f"No pictures: {error}"
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters["names"] = _names
    return environment.get_template("report.html.j2").render(
        kind="Quick" if quick else "Full",
        made=_made(results),
        claims=list(claims(figures)),
        sections=list(sections(figures, folder)),
        pictures=drawn,
        not_drawn=not_drawn,
        errata=list(errata.errata()),
        results=results,
    )


def _names(text: str) -> Markup:
    """Names of the code, which a sentence has in backticks."""
    return Markup(re.sub("`(.*?)`", r"<code>\1</code>", str(escape(text))))


def _made(results: Sequence[Result]) -> str:
    """The commits and machines of the runs, in words; parts name their own commit where these differ."""
    commits = list(dict.fromkeys(result.commit for result in results if result.commit)) or [commit()]
    machines = list(dict.fromkeys(result.machine for result in results if result.machine)) or [machine()]
    of = f"commit {commits[0]}" if len(commits) == 1 else f"commits {', '.join(commits)}, which differ in other code"
    return f"{of}, on {' and '.join(machines)}"


def print_pdf(page: Path, pdf: Path) -> None:
    """Print the page. Raises SernError where there is no browser, or it fails."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise SernError("no report.pdf: it needs a browser that prints; install the Debian package chromium")
    with tempfile.TemporaryDirectory(prefix="sern-paper-") as profile:
        words = [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={profile}",
            "--no-pdf-header-footer",
        ]
        try:
            done = subprocess.run(
                [*words, f"--print-to-pdf={pdf}", page.as_uri()],
                capture_output=True,
                text=True,
                timeout=PRINT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise SernError(f"no report.pdf: {browser} had not printed it within {PRINT_S:g} s") from None
    if done.returncode != 0 or not pdf.exists():
        last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise SernError(f"no report.pdf: {browser} ended with {done.returncode}: {last}")
