"""`sern-client --config client.yaml`."""

from pathlib import Path
from typing import Annotated

import typer

from sern_client.daemon import run_client
from sern_runtime.config.client import load_client
from sern_runtime.config.shared import LogSection
from sern_runtime.entry import run_daemon


def command(
    config: Annotated[Path, typer.Option("--config", "-c", help="The client's configuration file (YAML).")],
) -> None:
    """Bridge this site's ROS topics to a SERN relay, until SIGTERM or Ctrl-C."""

    def log() -> LogSection:
        return load_client(config).model.log

    raise typer.Exit(run_daemon("sern-client", log, lambda shutdown: run_client(config, shutdown)))


def main() -> None:
    typer.run(command)


if __name__ == "__main__":
    main()
