"""`sern-relay --config relay.yaml`."""

from pathlib import Path
from typing import Annotated

import typer

from sern_relay.daemon import run_relay
from sern_runtime.config.relay import load_relay
from sern_runtime.config.shared import LogSection
from sern_runtime.entry import run_daemon


def command(
    config: Annotated[Path, typer.Option("--config", "-c", help="The relay's configuration file (YAML).")],
) -> None:
    """Carry ROS topics between SERN clients, until SIGTERM or Ctrl-C. SIGHUP reads keys and access rules anew."""

    def log() -> LogSection:
        return load_relay(config).model.log

    raise typer.Exit(run_daemon("sern-relay", log, lambda shutdown: run_relay(config, shutdown)))


def main() -> None:
    typer.run(command)


if __name__ == "__main__":
    main()
