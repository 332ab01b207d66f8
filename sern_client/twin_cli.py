"""`sern-twin --config twin.yaml`: a client whose endpoint keeps the twins of robots elsewhere."""

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sern_runtime import version
from sern_runtime.logs import LOG_FORMAT_HELP, LogFormat

if TYPE_CHECKING:
    from sern_runtime.config.shared import LogSection


def command(
    config: Annotated[Path, typer.Option("--config", "-c", help="The file of the twins (YAML): endpoint kind twin.")],
    log_format: Annotated[LogFormat | None, typer.Option("--log-format", help=LOG_FORMAT_HELP)] = None,
    _version: Annotated[
        bool, typer.Option("--version", callback=version.shown("sern-twin"), is_eager=True, help=version.HELP)
    ] = False,
) -> None:
    """Keep the twins of robots behind a SERN relay, until SIGTERM or Ctrl-C."""

    from sern_client.daemon import run_client
    from sern_core.vocabulary.errors import ConfigError
    from sern_runtime.config.client import load_client
    from sern_runtime.config.twin import TwinEndpoint
    from sern_runtime.config.yaml import read_document
    from sern_runtime.entry import run_daemon

    def log() -> "LogSection":
        model = load_client(config).model
        if not any(isinstance(section, TwinEndpoint) for section in model.endpoints):
            problem: ConfigError = read_document(config).error(
                ("endpoint",), "is of no twins: sern-twin needs kind: twin (for others there is sern-client)"
            )
            raise problem
        return model.log

    raise typer.Exit(run_daemon("sern-twin", log, lambda shutdown: run_client(config, shutdown), log_format=log_format))


def main() -> None:
    # Until the event loop takes the signals over: Ctrl-C during the imports is an end, not a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    typer.run(command)


if __name__ == "__main__":
    main()
