"""What the tools read from a running daemon: JSON over its HTTP server, and one line for what goes wrong.

Exit codes of `sern topics` and `sern echo`: 0 done (Ctrl-C too, it is how they are ended), 1 the daemon, the relay or
the topic could not be had, 2 wrong usage or configuration.
"""

import http.client
import json
import os
import sys
import urllib.error
import urllib.request
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_runtime.config.tokens import read_token
from sern_runtime.entry import EXIT_CONFIG, EXIT_FAILED

LOCAL_APIS: Final = tuple(f"http://127.0.0.1:{port}" for port in (5580, 5581, 5582))
"""Where the daemons of the examples answer: relay, robot, site."""
TOKEN_VARIABLE: Final = "SERN_TOKEN_FILE"
"""The environment variable with the file whose token is sent: `http.token_file` of the daemon that is asked."""
PROBED: Final = "/api/link"
PROBE_S: Final = 1.0
TIMEOUT_S: Final = 5.0

# A daemon's HTTP server is on loopback or on a private network: a proxy for the outside must not come in between.
_opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))


class SilentError(SernError):
    """A connection was made, and no answer came in time."""


class NotFoundError(SernError):
    """The daemon has no such path: it is another kind of daemon, or an older one."""


class UnknownError(SernError):
    """The daemon has the path, and not what was asked for there; its own words say what it has."""


class DeniedError(SernError):
    """The daemon asks for a token, and got none or another."""


def checked_api(api: str) -> str:
    """`api` without a trailing slash. Raises UsageError when it is not http://HOST:PORT."""
    try:
        parts = urlsplit(api)
        good = parts.scheme in {"http", "https"} and parts.hostname and parts.port != 0
    except ValueError:
        good = False
    if not good:
        raise UsageError(f"--api {api!r} is not an address; write it like {LOCAL_APIS[0]}")
    return api.rstrip("/")


def local_api(apis: Sequence[str] | None = None) -> str:
    """The daemon of this machine, at the first of `apis` that answers (None: `LOCAL_APIS`). One before it that hangs is
    named on standard error. Raises SernError where none answers."""
    apis = LOCAL_APIS if apis is None else apis
    silent: list[str] = []
    for api in apis:
        try:
            get_json(api, PROBED, timeout_s=PROBE_S)
        except (ConfigError, DeniedError):
            raise
        except SilentError:
            silent.append(api.removeprefix("http://"))
        except SernError:
            continue
        else:
            if silent:
                print(f"warning: {_hung(silent)}; asking {api}", file=sys.stderr)
            return api
    if silent:
        raise SernError(f"no daemon answers on this machine; {_hung(silent)}")
    ports = ", ".join(api.rpartition(":")[2] for api in apis)
    raise SernError(
        f"no daemon answers on this machine (127.0.0.1, ports {ports}); is one running, and is http.listen set in its "
        "file? --api gives another address"
    )


def _hung(addresses: list[str]) -> str:
    return f"{', '.join(addresses)} takes connections and is silent: its daemon hangs, or it is none of SERN"


def get_json(api: str, path: str, *, timeout_s: float | None = None) -> Any:
    """The JSON at `path` of the daemon at `api`. Raises NotFoundError for a path it lacks, UnknownError and UsageError
    in the daemon's words for what it does not have or take there, DeniedError where it wants another token, ConfigError
    for a token that cannot be read, else SernError.

    `timeout_s`: how long it may be silent; None: `TIMEOUT_S`.
    """
    try:
        request = urllib.request.Request(api + path, headers=_authorization())
        with _opener.open(request, timeout=TIMEOUT_S if timeout_s is None else timeout_s) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as error:
        with error:
            if error.code == 401:
                raise DeniedError(_denied(api)) from None
            said = _said(error)
            if error.code == 404:
                if said:
                    raise UnknownError(f"{api}: {said}") from None
                raise NotFoundError(f"{api} has no {path}: it is another kind of daemon") from None
            if error.code == 400 and said:
                raise UsageError(f"{api}: {said}") from None
            raise SernError(f"{api}{path}: HTTP status {error.code}; see the daemon's log") from None
    except urllib.error.URLError as error:
        reason = getattr(error.reason, "strerror", None) or error.reason
        raise SernError(
            f"{api}: no answer ({str(reason).lower()}); is the daemon running, and is http.listen set in its file?"
        ) from None
    except TimeoutError:
        raise SilentError(f"{api}{path}: no answer in time; it hangs, or is no SERN daemon") from None
    except (OSError, http.client.HTTPException, ValueError):
        raise SernError(f"{api}{path}: the answer is not JSON; is this a SERN daemon?") from None


def _authorization() -> dict[str, str]:
    """The header with the token, where the environment names a file with one. Raises ConfigError."""
    name = os.environ.get(TOKEN_VARIABLE)
    if not name:
        return {}
    try:
        return {"Authorization": f"Bearer {read_token(Path(name))}"}
    except ConfigError as error:
        raise ConfigError(f"{TOKEN_VARIABLE}: {error}") from None


def _denied(api: str) -> str:
    name = os.environ.get(TOKEN_VARIABLE)
    if not name:
        return f"{api} asks for a token: put the file of its http.token_file into {TOKEN_VARIABLE}"
    return f"{api} does not take the token in {name} ({TOKEN_VARIABLE}); it must be that of its http.token_file"


def _said(error: urllib.error.HTTPError) -> str:
    """The line with which a daemon says what is wrong with a question; empty: it did not."""
    try:
        answer = json.load(error)
    except (OSError, http.client.HTTPException, ValueError):
        return ""
    said = answer.get("error") if isinstance(answer, dict) else None
    return " ".join(said.split()) if isinstance(said, str) else ""


def is_stream(item: Mapping[str, Any]) -> bool:
    """Whether this element of /api/objects stands for a topic of one publisher, and not for a transform or a node."""
    attributes: Mapping[str, str] = item["attributes"]
    return "topic" in attributes and "encoding" in attributes


def say(program: str, error: SernError) -> int:
    """Print `error` as one line and give the exit code for it."""
    print(f"{program}: {error}", file=sys.stderr)
    return EXIT_CONFIG if isinstance(error, (ConfigError, UsageError)) else EXIT_FAILED


def drop_output() -> None:
    """Whoever read our output has gone (`sern ... | head`): what is left to flush goes nowhere."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
