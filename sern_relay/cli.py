"""`sern-relay --config relay.yaml`."""

import gc
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sern_runtime import version
from sern_runtime.logs import LOG_FORMAT_HELP, LogFormat

if TYPE_CHECKING:
    from sern_runtime.config.shared import LogSection


def command(
    config: Annotated[Path, typer.Option("--config", "-c", help="The relay's configuration file (YAML).")],
    log_format: Annotated[LogFormat | None, typer.Option("--log-format", help=LOG_FORMAT_HELP)] = None,
    _version: Annotated[
        bool, typer.Option("--version", callback=version.shown("sern-relay"), is_eager=True, help=version.HELP)
    ] = False,
) -> None:
    """Carry ROS topics between SERN clients, until SIGTERM or Ctrl-C. SIGHUP reads keys and access rules anew."""

    from sern_relay.daemon import run_relay
    from sern_runtime.config.relay import load_relay
    from sern_runtime.entry import run_daemon

    def log() -> "LogSection":
        return load_relay(config).model.log

    raise typer.Exit(run_daemon("sern-relay", log, lambda shutdown: run_relay(config, shutdown), log_format=log_format))


def main() -> None:
    # Until the event loop takes the signals over: Ctrl-C during the imports is an end, not a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    gc.disable()  # imports leave next to nothing to collect; `CollectorWatch.settle` has it go on
    typer.run(command)


if __name__ == "__main__":
    main()
