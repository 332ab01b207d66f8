"""`sern recover`: finishes recordings that a killed process left behind."""

from pathlib import Path
from typing import Annotated

import typer

from sern_client.endpoints.leftovers import finish, in_use
from sern_core.vocabulary.errors import ConfigError


def recover(
    files: Annotated[list[Path], typer.Argument(help="What was left: NAME.bag.active or NAME.mcap.active.")],
) -> None:
    """Finish recordings that were left by a process that was killed; each gets its name without .active."""
    failed = False
    for file in files:
        try:
            if not file.exists():
                raise ConfigError("no such file", file=str(file))
            if in_use(file):
                raise ConfigError("is being recorded now; stop that first", file=str(file))
            done = finish(file)
        except ConfigError as error:
            typer.echo(f"sern recover: {error}", err=True)
            failed = True
        except OSError as error:
            typer.echo(f"sern recover: {file}: {error.strerror or error}; make room and try again", err=True)
            failed = True
        else:
            if done.messages is None:
                text = f"nothing of it can be read ({done.problem}); it is kept as {done.path}"
                typer.echo(f"sern recover: {file}: {text}", err=True)
                failed = True
            else:
                typer.echo(f"{done.path}: {done.messages} messages")
    if failed:
        raise typer.Exit(1)
