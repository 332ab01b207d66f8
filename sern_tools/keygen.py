"""`sern keygen relay NAME` and `sern keygen client NAME`: make a key pair, and say what to copy where.

What `sern keygen fabric` makes is in `keygen_fabric`.
"""

from pathlib import Path
from typing import Annotated, Literal

import typer

from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_core.vocabulary.names import client_name
from sern_core.vocabulary.types import ClientName
from sern_runtime.config import keys

EXIT_USER_ERROR = 2

Role = Literal["relay", "client"]


def run_keygen(role: Role, name: str, *, out: Path = Path(), force: bool = False) -> str:
    """Write `NAME.pub` and `NAME.key` into `out`, and return what the person should do next.

    Raises UsageError for a bad name, ConfigError when a file exists (without `force`) or can not be written; then
    nothing was written, or what was written is named.
    """
    owner = client_name(name)
    public_path = out / f"{name}{keys.PUBLIC_SUFFIX}"
    secret_path = out / f"{name}{keys.SECRET_SUFFIX}"
    if not force:
        for path in (public_path, secret_path):
            if path.exists() or path.is_symlink():
                raise ConfigError("exists already; --force replaces it (and locks out whoever uses it)", file=str(path))
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"can not be made: {error.strerror or error}", file=str(out)) from error
    pair = write_pair(owner, out, out, replace=force)
    advice = _relay_advice if role == "relay" else _client_advice
    return (
        f"wrote {secret_path} (secret, mode 0600) and {public_path} (public)\n"
        f"fingerprint {keys.fingerprint(pair.public_key)}\n"
    ) + advice(name, secret_path, public_path)


def write_pair(name: ClientName, directory: Path, public_directory: Path, *, replace: bool = False) -> keys.SecretKey:
    """A new pair, written as `NAME.key` and `NAME.pub`. ConfigError when one cannot be written."""
    pair = keys.generate(name)
    keys.write_secret(directory / f"{name}{keys.SECRET_SUFFIX}", pair, replace=replace)
    public = keys.PublicKeys(name, (keys.PublicKey(pair.public_key),))
    keys.write_public(public_directory / f"{name}{keys.PUBLIC_SUFFIX}", public, replace=replace)
    return pair


def make_keys(directory: Path, relay: str, *clients: str) -> None:
    """New keys of a whole system in one folder: `NAME.key` of each, the relay's `.pub` beside them, those of the
    clients in a new folder `clients`, as the relay's `clients_dir` wants them.

    Raises UsageError for a bad name, ConfigError when a key cannot be written, OSError when the folder cannot be made.
    """
    names = [client_name(name) for name in (relay, *clients)]
    theirs = directory / "clients"
    theirs.mkdir(parents=True)
    for name in names:
        write_pair(name, directory, directory if name == relay else theirs)


def _relay_advice(name: str, secret: Path, public: Path) -> str:
    return f"""\
Next:
  1. Keep {secret.name} on the relay, and name it in relay.yaml:
       relay: {{name: {name}, secret_key_file: {secret.name}, clients_dir: clients, ...}}
  2. Copy {public.name} to every client, and name it in client.yaml:
       relay: {{server_key_file: {public.name}, ...}}
"""


def _client_advice(name: str, secret: Path, public: Path) -> str:
    return f"""\
Next:
  1. Keep {secret.name} on the client, and name it in client.yaml:
       client: {{name: {name}}}
       relay: {{secret_key_file: {secret.name}, ...}}
  2. Copy {public.name} into the relay's clients_dir.
  3. Grant it something in relay.yaml. This lets it publish its own topics and receive what others send it:
       access:
         - {{client: {name}, publish: ["/{{self}}/.*"], subscribe: ["/{{self}}/.*"]}}
     and this is an operator who sees every topic and commands every robot:
         - {{client: {name}, publish: [".*/cmd_vel"], subscribe: [".*"]}}
"""


app = typer.Typer(
    help="Make keys: a CURVE pair of a relay or a client, certificates of a fabric.", no_args_is_help=True
)

_Name = Annotated[str, typer.Argument(help="Name: a lower-case letter, then up to 62 of a-z, 0-9, '_'.")]
_Out = Annotated[Path, typer.Option("--out", help="Directory for the two files; made if it is not there.")]
_Force = Annotated[bool, typer.Option("--force", help="Replace files that exist.")]


def _command(role: Role, name: str, out: Path, force: bool) -> None:
    try:
        typer.echo(run_keygen(role, name, out=out, force=force), nl=False)
    except SernError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(EXIT_USER_ERROR) from error


@app.command("relay")
def relay_command(name: _Name, out: _Out = Path(), force: _Force = False) -> None:
    """Make the key pair of a relay."""
    _command("relay", name, out, force)


@app.command("client")
def client_command(name: _Name, out: _Out = Path(), force: _Force = False) -> None:
    """Make the key pair of a client."""
    _command("client", name, out, force)


@app.command("fabric")
def fabric_command(
    names: Annotated[list[str] | None, typer.Argument(help="The relays, for a new authority.")] = None,
    relay: Annotated[
        list[str] | None, typer.Option("--relay", help="Add this relay to the authority in --out.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Directory for the files; made if it is not there.")] = Path(),
) -> None:
    """Make the certificates by which the relays of one fabric know each other. Nothing is overwritten."""
    from sern_tools.keygen_fabric import add_relays, make_fabric

    try:
        if names and relay:
            raise UsageError("name relays for a new authority, or give --relay NAME to add one to it; not both")
        typer.echo(add_relays(relay, out=out) if relay else make_fabric(names or (), out=out), nl=False)
    except SernError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(EXIT_USER_ERROR) from error


if __name__ == "__main__":
    app()
