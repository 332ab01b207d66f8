"""The `sern` command: its entry. The subcommands are in `sern_tools.commands`."""

import signal


def main() -> None:
    # Ctrl-C during the imports, which take a second, is an end, not a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from sern_tools.commands import app

    signal.signal(signal.SIGINT, signal.default_int_handler)
    app()


if __name__ == "__main__":
    main()
