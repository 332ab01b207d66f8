"""Patterns of names: regular expressions that must match the whole name, in time linear in its length. Pure.

Patterns come from files, command lines and peers, and all of them are matched by RE2: whatever the pattern, a match
costs at most a few nanoseconds for each instruction of its program and each character of the name. `MAX_PROGRAM` bounds
the first, `NAME_MAX_CHARS` (rules.py) the second. RE2 has no look-around and no back-references.

Names and patterns are printable ASCII. A name that is not matches no pattern.
"""

import re
from collections.abc import Iterable
from typing import Final

import re2

from sern_core.vocabulary.errors import UsageError

PATTERN_MAX_CHARS: Final = 512
MAX_PROGRAM: Final = 2048
"""Instructions of one pattern: about one for a character, and as many times that as a repeat says."""
MAX_CLIENT_PROGRAM: Final = 4096
"""Instructions of all patterns that one client subscribes to. With so many, matching a name of 40 characters takes at
most about half a millisecond, whatever the patterns and the name are."""
_MATCHER_BYTES: Final = 128 * 1024
"""What RE2 may keep for one matcher. More lets hostile patterns spend it on states that are used once (measured)."""
_PLAIN: Final = re.compile(r"[A-Za-z0-9_/]+(?:\.\*)?|\.\*[A-Za-z0-9_/]*")
"""Patterns that need no matcher."""
_SPECIAL: Final = re.compile(
    r"\\(?:x\{[^}]*\}|[pP]\{[^}]*\}|.)|\[\^?\]?(?:\[:\^?\w+:\]|\\.|[^\]\\])*\]|\{,\d*\}|\{\d*,?\d{5,}"
)
"""Escapes and classes, so that nothing inside of them is taken for the repeats that are looked for."""
_BACK_REFERENCE: Final = re.compile(r"invalid escape sequence: \\[1-9]")
_START_CHARS: Final = 64
_ANYTHING: Final = ".*"
_SHORTER: Final = "use fewer or shorter patterns, or smaller repeats"


def _options() -> re2.Options:
    options = re2.Options()
    options.max_mem = _MATCHER_BYTES
    options.log_errors = False  # it would write to stderr
    options.never_capture = True
    options.encoding = re2.Options.Encoding.LATIN1  # bytes are characters: everything is ASCII
    return options


_OPTIONS: Final = _options()


class PatternError(UsageError):
    """A text is no pattern, as a phrase that goes after it. `text`: which; None: no single one is at fault."""

    def __init__(self, text: str | None, problem: str) -> None:
        super().__init__(problem)
        self.text = text


class PatternSet:
    """Matches a name that at least one of some patterns matches whole.

    Plain names, `prefix.*`, `.*suffix` and alternatives of these are compared as text; the others together are one
    alternation (or a few, where there are very many), which is asked about names that begin as one of its matches may.
    Raises PatternError for a text that is no pattern, or too large, and when all together have more than `max_program`
    instructions; None: any number.
    """

    __slots__ = ("_exact", "_prefixes", "_regexps", "_starts", "_suffixes", "program", "texts")

    def __init__(self, texts: Iterable[str], *, max_program: int | None = None) -> None:
        self.texts = tuple(texts)
        exact, prefixes, suffixes, starts = set[str](), list[str](), list[str](), list[str]()
        groups: list[tuple[int, list[str]]] = []
        self.program = 0
        """Instructions of all alternations: what a match may cost for each character. 0: nothing but comparisons."""
        for text in self.texts:
            _check_text(text)
            parts = text.split("|")
            if all(_PLAIN.fullmatch(part) for part in parts):
                for part in parts:
                    if part.endswith(_ANYTHING):
                        prefixes.append(part.removesuffix(_ANYTHING))
                    elif part.startswith(_ANYTHING):
                        suffixes.append(part.removeprefix(_ANYTHING))
                    else:
                        exact.add(part)
                continue
            regexp = _compiled(text, text)
            program = regexp.programsize
            if program > MAX_PROGRAM:
                raise PatternError(text, f"is too large (more than {MAX_PROGRAM} steps); {_SHORTER}")
            self.program += program
            if max_program is not None and self.program > max_program:
                problem = f"the patterns are too large together (more than {max_program} steps); {_SHORTER}"
                raise PatternError(None, problem)
            starts.append(_start(regexp))
            if groups and groups[-1][0] + program <= MAX_PROGRAM:
                groups[-1] = (groups[-1][0] + program, [*groups[-1][1], text])
            else:
                groups.append((program, [text]))
        self._exact = frozenset(exact)
        self._prefixes = tuple(prefixes)
        self._suffixes = tuple(suffixes)
        self._starts = tuple(starts)
        # Each was compiled alone before: none can break out of its group.
        self._regexps = tuple(_compiled("|".join(f"(?:{text})" for text in group), None) for _, group in groups)

    def fullmatch(self, name: str) -> bool:
        """Whether one of the patterns matches the whole name."""
        if name in self._exact:
            return True
        if (self._prefixes and name.startswith(self._prefixes)) or (self._suffixes and name.endswith(self._suffixes)):
            return name.isascii() and "\n" not in name
        if not self.steps(name) or not name.isascii() or "\n" in name:
            return False
        text = name.encode("ascii")
        return any(regexp.fullmatch(text) is not None for regexp in self._regexps)

    def steps(self, name: str) -> int:
        """How many instructions a match may take for each character of this name; 0: it is compared as text."""
        return self.program if self._starts and name.startswith(self._starts) else 0

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PatternSet) and self.texts == other.texts

    def __hash__(self) -> int:
        return hash(self.texts)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(map(repr, self.texts))})"


class Pattern(PatternSet):
    """One pattern."""

    __slots__ = ()

    def __init__(self, text: str) -> None:
        super().__init__((text,))

    @property
    def pattern(self) -> str:
        """Its text."""
        return self.texts[0]


def compile_pattern(text: str) -> Pattern:
    """A pattern for `fullmatch`; PatternError with one line for what is none in RE2's syntax, or too large."""
    return Pattern(text)


def matches_a_name(text: str) -> bool:
    """Whether a match of a pattern may begin with '/', as every name does. False: it matches none."""
    _check_text(text)
    try:
        low, high = _compiled(text, text).possiblematchrange(_START_CHARS)
    except re2.error:  # anything may begin it
        return True
    return bool(low[:1] <= b"/" <= high[:1])


def _check_text(text: str) -> None:
    """Raises PatternError for a text that is no pattern, before RE2 is asked."""
    if not text:
        raise PatternError(text, "is empty; '.*' matches everything")
    if len(text) > PATTERN_MAX_CHARS:
        raise PatternError(text, f"is longer than {PATTERN_MAX_CHARS} characters")
    if not (text.isascii() and text.isprintable()):
        raise PatternError(text, "holds something else than printable ASCII; names are letters, digits, '_' and '/'")
    for found in _SPECIAL.finditer(text):
        # What RE2 reads as text and other engines as a repeat, and what would hide the end of a group.
        part = found[0]
        if part.startswith("{,"):
            raise PatternError(text, f"has {part}, which is no repeat in RE2; write {{0{part[1:]}")
        if part.startswith("{"):
            raise PatternError(text, f"has a repeat of {part[1:20]}; at most 1000")
        if part == r"\Q":
            raise PatternError(text, r"has \Q; put '\' before each special character instead")


def _compiled(text: str, blame: str | None) -> "re2.Regexp":
    try:
        compiled = re2.compile(text.encode("ascii"), _OPTIONS)
    except re2.error as error:
        raise PatternError(blame, _why(error)) from None
    re2.purge()  # its own cache would keep what peers send
    return compiled


def _start(regexp: "re2.Regexp") -> str:
    """What every match of it begins with."""
    try:
        low, high = regexp.possiblematchrange(_START_CHARS)
    except re2.error:
        return ""
    same = next((at for at, (one, other) in enumerate(zip(low, high, strict=False)) if one != other), None)
    return low[:same].decode("latin-1") if same is not None else min(low, high, key=len).decode("latin-1")


def _why(error: Exception) -> str:
    said = error.args[0] if error.args else ""
    reason = said.decode("latin-1") if isinstance(said, bytes) else str(said)
    if reason.startswith("pattern too large"):
        return f"is too large (more than {MAX_PROGRAM} steps); {_SHORTER}"
    if reason.startswith("missing "):
        reason = reason.partition(":")[0]  # what follows is the whole pattern
    elif reason.startswith("invalid perl operator"):
        reason = reason.removeprefix("invalid perl operator: ") + ": RE2 has no look-around and no conditions"
    elif _BACK_REFERENCE.match(reason):
        reason = reason.removeprefix("invalid escape sequence: ") + ": RE2 has no back-references"
    return f"is not a regular expression ({reason[:80]})"
