"""`sern-navigation --config navigation.yaml`: a node that drives its robot to its goals."""

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sern_runtime import version
from sern_runtime.logs import LOG_FORMAT_HELP, LogFormat

if TYPE_CHECKING:
    from sern_runtime.config.shared import LogSection


def command(
    config: Annotated[Path, typer.Option("--config", "-c", help="The navigation's configuration file (YAML).")],
    log_format: Annotated[LogFormat | None, typer.Option("--log-format", help=LOG_FORMAT_HELP)] = None,
    _version: Annotated[
        bool, typer.Option("--version", callback=version.shown("sern-navigation"), is_eager=True, help=version.HELP)
    ] = False,
) -> None:
    """Drive a robot to its goals, by its own sensors and the twin's advice, until SIGTERM or Ctrl-C."""

    from sern_runtime.entry import EXIT_CONFIG, run_daemon

    try:
        from sern_client.navigation.daemon import run_navigation
        from sern_runtime.config.navigation import load_navigation
    except ImportError as error:
        from sern_runtime.config.endpoints import installing

        package = installing("'sern[twin]'")
        typer.echo(f"sern-navigation: needs more packages: {package} ({error})", err=True)
        raise typer.Exit(EXIT_CONFIG) from None

    def log() -> "LogSection":
        return load_navigation(config).model.log

    raise typer.Exit(
        run_daemon("sern-navigation", log, lambda shutdown: run_navigation(config, shutdown), log_format=log_format)
    )


def main() -> None:
    # Until the event loop takes the signals over: Ctrl-C during the imports is an end, not a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    typer.run(command)


if __name__ == "__main__":
    main()
