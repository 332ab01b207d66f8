"""The `sern` command. Every subcommand is registered here, in one place."""

from typing import Annotated

import typer

from sern_runtime import version
from sern_tools import check, enroll, keygen, keys, spool
from sern_tools.clients import clients
from sern_tools.demo import demo
from sern_tools.demo_navigation import demo_navigation
from sern_tools.demo_twin import demo_twin
from sern_tools.echo import echo
from sern_tools.events import events
from sern_tools.explain import explain
from sern_tools.lab.cli import app as lab_app
from sern_tools.operate import release_command, set_command, take_command
from sern_tools.recover import recover
from sern_tools.top import top
from sern_tools.topics import topics

app = typer.Typer(
    name="sern",
    help="Keep a robot's virtual twin and its operator useful over thin, lossy, broken links.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@app.callback()
def _options(
    _version: Annotated[
        bool, typer.Option("--version", callback=version.shown("sern"), is_eager=True, help=version.HELP)
    ] = False,
) -> None:
    pass


app.command()(demo)
app.command("demo-twin")(demo_twin)
app.command("demo-navigation")(demo_navigation)
app.add_typer(keygen.app, name="keygen")
app.add_typer(keys.app, name="keys")
app.add_typer(enroll.app, name="enroll")
app.add_typer(lab_app, name="lab")
app.add_typer(spool.app, name="spool")
app.command("check")(check.check_command)
app.command()(top)
app.command()(topics)
app.command()(clients)
app.command()(events)
app.command("set")(set_command)
app.command("release")(release_command)
app.command("take")(take_command)
app.command()(echo)
app.command()(explain)
app.command()(recover)
