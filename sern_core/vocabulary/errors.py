"""The exceptions of SERN.

SernError
├── UsageError            local misuse: the caller broke a documented duty
├── ConfigError           a file a person wrote is wrong (file, line, key path, what is accepted)
├── BodyError             a message body that does not fit its type, or a layout that is not read here
└── RemoteError           a peer did something wrong or said no
    ├── WireError         bytes that are not a valid frame
    ├── CodecError        an encoded body that cannot be decoded
    ├── VersionError      no wire version in common
    ├── RefusedError      the peer refused us, with its reason
    └── ServiceError      a service call got no answer, and why

Each renders as one line: what, where, what to do.
"""


class SernError(Exception):
    """Base of every exception that SERN raises on purpose."""


class UsageError(SernError):
    """The caller broke a documented duty of this API."""


class ConfigError(SernError):
    """A file that a person wrote is wrong.

    Fields: `problem` (what and what to do), `file`, `line` (1-based), `key` (dotted path); all but the first optional.
    """

    def __init__(
        self, problem: str, *, file: str | None = None, line: int | None = None, key: str | None = None
    ) -> None:
        super().__init__(problem)
        self.problem = problem
        self.file = file
        self.line = line
        self.key = key

    def __str__(self) -> str:
        where = self.file or ""
        if where and self.line is not None:
            where += f":{self.line}"
        parts = [part for part in (where, self.key, self.problem) if part]
        return ": ".join(parts)


class BodyError(SernError):
    """The bytes of a message do not fit its type, or are laid out in a way that is not read here."""


class RemoteError(SernError):
    """A peer did something wrong or said no."""


class WireError(RemoteError):
    """Bytes that are not a valid frame. The sender's connection is closed; nobody else notices."""


class CodecError(RemoteError):
    """An encoded body that is damaged, lies about its size, or is too large. Only its message is dropped."""


class VersionError(RemoteError):
    """The peers have no wire version in common."""


class RefusedError(RemoteError):
    """The peer refused us. `code` is a stable word for programs, the text is for people."""

    def __init__(self, code: str, problem: str) -> None:
        super().__init__(problem)
        self.code = code


class ServiceError(RemoteError):
    """A service call got no answer: no such service, an error of its own, the link, or the time. The caller is told."""
