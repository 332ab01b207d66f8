"""What every configuration model is made of: the base class, the checked text types, and `fault`.

A model field has a docstring below it (its description in the schema and in the reference) and a unit in its name.
Validators raise `fault(...)` with a finished phrase; `load.py` puts file, line and key in front of it.
"""

import ipaddress
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    ValidationError,
    WrapValidator,
)
from pydantic_core import CoreSchema, PydanticCustomError

from sern_core.relay.access import LONGEST_NAME, with_self
from sern_core.topics.patterns import compile_pattern, matches_a_name
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.names import client_name, normal_namespace, topic_name
from sern_runtime.config.yaml import Data, Loc

_HOST: Final = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9_.-]{0,251}[A-Za-z0-9_])?")
_TCP: Final = re.compile(r"tcp://(\[[0-9A-Fa-f:.%a-z]+\]|[^:/\[\]]+):([0-9]{1,5})")
_IPC_MAX_CHARS: Final = 100  # a Unix socket path holds 107 bytes on Linux
_SOCKET_MAX_BYTES: Final = 107
LONG_COMMAND_S: Final = 60.0
"""A command that is older moves nobody's robot on purpose."""
UNITS_CONFIGURED: Final = Path("/etc")
UNITS_WRITE: Final = Path("/var/lib/sern")
"""Where the configuration of the systemd units is, and all that they let a daemon write (`deploy/systemd`)."""
_LOOPBACK_NAMES: Final = frozenset({"localhost", "ip6-localhost"})


class Section(BaseModel):
    """A mapping in a configuration file: unknown keys are errors, and nothing is converted behind the writer's back."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        hide_input_in_errors=True,
    )

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """The schema with what each key means. (pydantic's own `use_attribute_docstrings` reads the source of every
        class when it is imported.)"""
        from sern_runtime.config.meanings import meaning

        schema = handler(core_schema)
        keys = handler.resolve_ref_schema(schema)["properties"]
        for name, field in cls.model_fields.items():
            key = keys[field.alias or name]
            text = meaning(cls, name)
            # What a section says of itself need not be said again where it is referred to.
            if text is not None and handler.resolve_ref_schema(key).get("description") != text:
                key.setdefault("description", text)
        return schema


@dataclass(frozen=True, slots=True)
class FileProblem:
    """Something about a file that the configuration names. A warning does not stop anything."""

    loc: Loc
    problem: str
    warning: bool = False


class EndpointBase(Section):
    """What all endpoint sections share."""

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        """Problems with the files this endpoint reads or writes; `loc` is its place. By default it has none."""
        del base_dir, loc
        return iter(())


class FileModel(Section):
    """A whole file. `file_problems` is the second step of checking: it looks at the other files that this one names."""

    @classmethod
    def foreign(cls, data: Mapping[str, Data]) -> str | None:
        """What is said of a file that is plainly another kind of ours; None: it may be of this one."""
        del data
        return None

    def placed(self, base_dir: Path) -> Self:
        """The same with its sockets (ipc://) where they are, relative paths starting at `base_dir`."""
        del base_dir
        return self

    def file_problems(self, base_dir: Path) -> Iterator[FileProblem]:
        """Problems with the files this one names; relative paths start at `base_dir`. By default it names none."""
        del base_dir
        return iter(())


def pattern_problems(texts: Iterable[str], loc: Loc) -> Iterator[FileProblem]:
    """Warnings of patterns that match no name, one after another in the list at `loc`."""
    for index, text in enumerate(texts):
        yield from pattern_problem(text, (*loc, index))


def pattern_problem(text: str, loc: Loc) -> Iterator[FileProblem]:
    """A warning of a pattern that matches no name; `{self}` in it is a client's name."""
    if not matches_a_name(with_self(text, LONGEST_NAME)):
        hint = f"; /{text}?" if re.match(r"[a-z]", text) else ""
        yield FileProblem(loc, f"{_shown(text)} matches no topic: names begin with '/'{hint}", warning=True)


def lifespan_problem(lifespan_s: object, loc: Loc, *, reliable: bool) -> Iterator[FileProblem]:
    """A warning of commands that move a robot long after they were given. `lifespan_s` as the file has it."""
    if isinstance(lifespan_s, (int, float)) and lifespan_s >= LONG_COMMAND_S:
        how = f"for up to {lifespan_s:g} s"
    elif lifespan_s is None and not reliable:
        how = "for ever"
    else:
        return
    problem = f"lets a command wait {how}, and then a robot moves by it; leave it out, or write a second or less"
    yield FileProblem(loc, problem, warning=True)


def fault(problem: str, *at: str | int) -> PydanticCustomError:
    """The error a validator raises. `at` leads from the validated value to the part at fault."""
    return PydanticCustomError("fault", "{problem}", {"problem": problem, "at": at})


def unexpected(expected: str) -> PydanticCustomError:
    """Like `fault`, for a value that is nothing like `expected`; the message shows the value."""
    return PydanticCustomError("unexpected", "expected {expected}", {"expected": expected})


def described(expected: str) -> WrapValidator:
    """Replaces whatever a union of types says by one phrase."""

    def validate(value: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            return handler(value)
        except ValidationError as error:
            raise unexpected(expected) from error

    return WrapValidator(validate)


def checked(check: Callable[[str], object]) -> AfterValidator:
    """A validator that leaves the text as it is and reports the UsageError of `check`."""

    def validate(text: str) -> str:
        try:
            check(text)
        except UsageError as error:
            raise fault(str(error)) from error
        return text

    return AfterValidator(validate)


def _check_self_pattern(text: str) -> None:
    compile_pattern(with_self(text, LONGEST_NAME))


def _check_path(text: str) -> None:
    if not text or "\n" in text:
        raise UsageError("must be the path of a file, relative to this one or absolute")


def _check_phrase(text: str) -> None:
    if not re.fullmatch(r"[a-z][a-z0-9_-]{0,57}", text):
        raise UsageError("must be a lower-case letter, then up to 57 of a-z, 0-9, '_', '-'")


def _check_frame_prefix(text: str) -> None:
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_/]{0,63}", text):
        raise UsageError("must be 1 to 64 letters, digits, '_' or '/', not '/' first, such as jackal1/")


def split_tcp(endpoint: str) -> tuple[str, int] | None:
    """Host and port of `tcp://host:port`, brackets of IPv6 removed; None for anything else."""
    match = _TCP.fullmatch(endpoint)
    return None if match is None else (match[1].strip("[]"), int(match[2]))


def is_local(endpoint: str) -> bool:
    """True for ipc and for tcp on the loopback interface: nobody else's packets get there."""
    if endpoint.startswith("ipc://"):
        return True
    parts = split_tcp(endpoint)
    return parts is not None and _is_loopback(parts[0])


def _is_loopback(host: str) -> bool:
    address = _address(host)
    return host in _LOOPBACK_NAMES if address is None else address.is_loopback


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _check_ipc(endpoint: str) -> None:
    path = endpoint.removeprefix("ipc://")
    if not path or len(path.encode()) > _IPC_MAX_CHARS or "\n" in path:
        raise UsageError(f"ipc:// needs a path of 1 to {_IPC_MAX_CHARS} bytes")


def _check_port(port: int) -> None:
    if not 1 <= port <= 65535:
        raise UsageError(f"port {port} is not in 1..65535")


def _check_connect(endpoint: str) -> None:
    if endpoint.startswith("ipc://"):
        return _check_ipc(endpoint)
    parts = split_tcp(endpoint)
    if parts is None or not (_HOST.fullmatch(parts[0]) or _address(parts[0])):
        raise UsageError(f"{_shown(endpoint)} is not an endpoint; accepted: tcp://host:port, ipc://path")
    return _check_port(parts[1])


def _check_bind(endpoint: str) -> None:
    if endpoint.startswith("ipc://"):
        return _check_ipc(endpoint)
    parts = split_tcp(endpoint)
    if parts is None:
        raise UsageError(
            f"{_shown(endpoint)} is not an address; accepted: tcp://address:port, tcp://*:port, ipc://path"
        )
    if parts[0] != "*" and _address(parts[0]) is None:
        raise UsageError(f"{_shown(parts[0])} is a name; listen on an address of this host, 127.0.0.1, 0.0.0.0 or *")
    return _check_port(parts[1])


def check_address(text: str, *, bind: bool) -> None:
    """Raises UsageError where `text` is not `host:port`; `bind`: an address of this host, or `*`, and no name."""
    (_check_bind if bind else _check_connect)("tcp://" + text)


def _check_http(listen: str) -> None:
    parts = split_tcp("tcp://" + listen)
    if parts is None or _address(parts[0]) is None:
        raise UsageError(f"{_shown(listen)} is not address:port, such as 127.0.0.1:5580")
    _check_port(parts[1])


def _shown(text: str) -> str:
    return repr(text if len(text) <= 80 else text[:77] + "...")


Pattern = Annotated[str, checked(compile_pattern), Field(json_schema_extra={"format": "regex"})]
SelfPattern = Annotated[str, checked(_check_self_pattern)]
TopicText = Annotated[str, checked(topic_name)]
ClientText = Annotated[str, checked(client_name)]
NamespaceText = Annotated[str, checked(normal_namespace)]
RoleText = Annotated[str, checked(_check_phrase)]
FramePrefix = Annotated[str, checked(_check_frame_prefix)]
PathText = Annotated[str, checked(_check_path)]
ConnectEndpoint = Annotated[str, checked(_check_connect)]
BindEndpoint = Annotated[str, checked(_check_bind)]
HttpListen = Annotated[str, checked(_check_http)]

Seconds = Annotated[float, Field(gt=0, le=1e7)]
SecondsOrZero = Annotated[float, Field(ge=0, le=1e7)]
Hertz = Annotated[float, Field(gt=0, le=1e6)]
HertzOrOff = Annotated[float, Field(ge=0, le=1e6)]
Bytes = Annotated[int, Field(ge=1, le=1 << 40)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]


def resolve(base_dir: Path, text: str) -> Path:
    """A path from a configuration file: `~` is the home directory, relative ones start at the file's directory."""
    return base_dir / Path(text).expanduser()


def missing_directories(base_dir: Path, paths: tuple[str, ...], loc: Loc) -> Iterator[FileProblem]:
    """A problem for each of the paths that is no directory."""
    for index, text in enumerate(paths):
        path = resolve(base_dir, text)
        if not path.is_dir():
            yield FileProblem((*loc, index), f"{path}: no such directory")


def unit_problems(base_dir: Path, path: Path, loc: Loc) -> Iterator[FileProblem]:
    """A warning of a file that the daemon is to write where the units of `deploy` let it write nothing: by the place of
    the configuration it is one of theirs, or the file is beside those that are."""
    written, configured = path.resolve(), UNITS_CONFIGURED
    by_unit = written.is_relative_to(configured) or base_dir.resolve().is_relative_to(configured)
    if by_unit and not written.is_relative_to(UNITS_WRITE):
        problem = (
            f"{path}: under the systemd units nothing can be written outside of {UNITS_WRITE}; name a path there, or "
            "add ReadWritePaths= to the unit"
        )
        yield FileProblem(loc, problem, warning=True)


def unit_makes(base_dir: Path, directory: Path) -> bool:
    """Whether a folder that may not be there yet is the one that systemd makes when it starts the unit."""
    return directory == UNITS_WRITE and base_dir.resolve().is_relative_to(UNITS_CONFIGURED)


def place(base_dir: Path, endpoint: str) -> str:
    """An endpoint with the path of an ipc:// one as `resolve` has it; abstract names (@) and ipc://* are no paths."""
    path = endpoint.removeprefix("ipc://")
    if path == endpoint or path.startswith(("/", "@")) or path == "*":
        return endpoint
    return f"ipc://{resolve(base_dir, path)}"


def socket_problems(base_dir: Path, endpoint: str | None, loc: Loc) -> Iterator[FileProblem]:
    """The problem of an ipc:// endpoint whose whole path is too long for a socket."""
    placed = "" if endpoint is None else place(base_dir, endpoint)
    if len(placed.removeprefix("ipc://").encode()) > _SOCKET_MAX_BYTES and placed.startswith("ipc://"):
        yield FileProblem(loc, f"{placed}: a path of 1 to {_SOCKET_MAX_BYTES} bytes is needed")
