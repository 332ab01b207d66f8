"""`--version`: which SERN this is, and whether its core is compiled."""

from collections.abc import Callable
from typing import Final

import typer

HELP: Final = "Show the version, and whether the core is compiled."


def compiled() -> bool:
    """Whether the core that runs here was compiled (`make wheel`), and is no Python source."""
    from sern_core.vocabulary import types

    return not str(types.__file__).endswith(".py")


def shown(program: str) -> Callable[[bool], None]:
    """What the option of a program does: it says one line, and ends the program."""

    def show(asked: bool) -> None:
        from importlib.metadata import version

        if asked:
            typer.echo(f"{program} {version('sern')}, {'compiled' if compiled() else 'plain Python'} core")
            raise typer.Exit

    return show
