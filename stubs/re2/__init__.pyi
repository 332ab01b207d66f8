from typing import Protocol

class error(Exception): ...  # noqa: N801, N818

class Options:
    class Encoding:
        UTF8: Options.Encoding
        LATIN1: Options.Encoding

    encoding: Options.Encoding
    max_mem: int
    log_errors: bool
    never_capture: bool

class Match(Protocol):
    def group(self, group: int = 0) -> bytes: ...

class Regexp(Protocol):
    @property
    def programsize(self) -> int: ...
    def possiblematchrange(self, maxlen: int) -> tuple[bytes, bytes]: ...
    def fullmatch(self, text: bytes) -> Match | None: ...

def compile(pattern: bytes, options: Options | None = None) -> Regexp: ...  # noqa: A001
def purge() -> None: ...
