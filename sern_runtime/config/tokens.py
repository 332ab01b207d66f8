"""Files with a token: what whoever asks over HTTP must know."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.config.base import FileProblem, PathText, resolve
from sern_runtime.config.keys import secret_warning
from sern_runtime.config.yaml import Loc

MIN_CHARS: Final = 16
MAX_CHARS: Final = 256
_MADE_BY: Final = "make one with (umask 077; openssl rand -hex 16 > FILE)"


def read_token(path: Path) -> str:
    """The token in a file: one line of MIN_CHARS to MAX_CHARS printable ASCII characters without spaces.

    Raises ConfigError, which never quotes what is in the file.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_CHARS + 3)
    except OSError as error:
        raise ConfigError(f"{path}: {(error.strerror or str(error)).lower()}; {_MADE_BY}") from error
    token = content.removesuffix(b"\n").removesuffix(b"\r")
    if not MIN_CHARS <= len(token) <= MAX_CHARS or not all(0x21 <= byte <= 0x7E for byte in token):
        raise ConfigError(
            f"{path} holds no token: one line of {MIN_CHARS} to {MAX_CHARS} printable ASCII characters without spaces "
            f"is needed; {_MADE_BY}"
        )
    return token.decode("ascii")


def token_problems(base_dir: Path, text: PathText | None, loc: Loc) -> Iterator[FileProblem]:
    """Problems of a token's file, if there is one."""
    if text is None:
        return
    path = resolve(base_dir, text)
    try:
        read_token(path)
    except ConfigError as error:
        yield FileProblem(loc, str(error))
        return
    warning = secret_warning(path)
    if warning is not None:
        yield FileProblem(loc, warning, warning=True)
