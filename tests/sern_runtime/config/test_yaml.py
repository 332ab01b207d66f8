"""YAML text as data with lines: the core schema, and the limits."""

from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.config import yaml
from sern_runtime.config.yaml import Data, Document, parse_document, read_document


def parse(text: str) -> Document:
    return parse_document(text.encode(), file="f.yaml")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("~", None),
        ("null", None),
        ("true", True),
        ("False", False),
        ("yes", "yes"),
        ("on", "on"),
        ("12", 12),
        ("-3", -3),
        ("010", 10),
        ("0o17", 15),
        ("0x1F", 31),
        ("1_000", "1_000"),
        ("12:30", "12:30"),
        ("1e3", 1000.0),
        (".5", 0.5),
        ("2.", 2.0),
        ("2026-01-31", "2026-01-31"),
        ("'12'", "12"),
        ('"a\\tb"', "a\tb"),
        ("[1, a, {b: ~}]", [1, "a", {"b": None}]),
        ("|\n  x\n  y\n", "x\ny\n"),
        ("١٢", "١٢"),  # digits of another script are text
    ],
)
def test_core_schema(text: str, value: Data) -> None:
    assert parse(f"a: {text}").data == {"a": value}


def test_aliases_are_copies_with_a_limit() -> None:
    document = parse("a: &x [1, 2]\nb: *x\nc: &k word\n*k : 3\n")
    assert document.data == {"a": [1, 2], "b": [1, 2], "c": "word", "word": 3}
    bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)
    )
    with pytest.raises(ConfigError, match=r"^f\.yaml:5: more than 20000 values"):
        parse(bomb)


def test_nesting_is_limited_also_by_aliases() -> None:
    deep = "a: " + "[" * (yaml.MAX_DEPTH - 1) + "]" * (yaml.MAX_DEPTH - 1)
    parse(deep)
    with pytest.raises(ConfigError, match=r"^f\.yaml:1: nested deeper than 16 levels$"):
        parse("a: " + "[" * 5000)
    chain = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 20))
    with pytest.raises(ConfigError, match=r"^f\.yaml:16: nested deeper than 16 levels$"):
        parse(chain)


def test_size_and_encoding_are_limited() -> None:
    with pytest.raises(ConfigError, match=r"^f: is larger than 262144 bytes$"):
        parse_document(b"#" * (yaml.MAX_FILE_BYTES + 1), file="f")
    with pytest.raises(ConfigError, match=r"^f:2: byte 0xff is not UTF-8 text$"):
        parse_document(b"a: 1\nb: \xff", file="f")
    with pytest.raises(ConfigError, match=r"^f:1: a: a number has at most 40 characters$"):
        parse_document(b"a: " + b"9" * 5000, file="f")
    assert parse_document(b"\xef\xbb\xbfa: 1", file="f").data == {"a": 1}


@pytest.mark.parametrize("text", ['a: "\\0"', 'a: "\\x1b[31m"', 'a: "\\ud800"', 'a: "\\u2028"', "a: \x07"])
def test_control_characters_are_refused_and_never_shown_raw(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(text)
    assert str(caught.value).isprintable()


def test_place_names_the_nearest_line() -> None:
    document = parse("a:\n  b:\n    - 1\n    -\n      c: 2\n")
    assert document.place(("a", "b", 1, "c")) == ("a.b.1.c", 5)
    assert document.place(("a", "b", 7, "c")) == ("a.b.7.c", 2)
    assert document.place(("a", "new key")) == ("a.'new key'", 1)
    assert str(document.error((), "is odd\nvery")) == "f.yaml:1: is odd\\nvery"


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no such file$"):
        read_document(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match=r"is a directory; a file is needed$"):
        read_document(tmp_path)
    with pytest.raises(ConfigError, match="can not be read"):
        read_document(tmp_path / "a\0b")
