"""Any bytes, and any values in the right places: accepted, or ConfigError in one printable line, nothing else."""

import json
from pathlib import Path

from hypothesis import example, given, settings
from hypothesis import strategies as st

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.config import keys
from sern_runtime.config.base import FileModel
from sern_runtime.config.client import ClientFile
from sern_runtime.config.load import accepted_keys, check_bytes, models_in
from sern_runtime.config.relay import RelayFile
from sern_runtime.config.yaml import parse_document
from tests.exploring import cases

MODELS: tuple[type[FileModel], ...] = (ClientFile, RelayFile, keys.PublicKeyFile, keys.SecretKeyFile)
STEADY = settings(max_examples=cases(400))

# Characters and words that mean something to YAML, so that a good part of the examples gets past the scanner.
_PARTS = (
    *("a", "b", "client", "name", ": ", ":", "\n", "\n  ", "\n- ", "- ", "[", "]", "{", "}", ", ", "&a ", "*a", "!t "),
    *("'", '"', "\\", "|", ">", "|-\n", "%YAML 1.1\n", "%TAG ! x\n", "---\n", "...\n", "# c\n", "? ", "<<", "~"),
    *("1", "0x1", "1e9", ".inf", "@", "`", "\t", "\u2028", "\ufeff", "\x85", "é", "\x00", "\\ud800", '"\\x"', "!!int "),
)
YAML_TEXT = st.lists(st.sampled_from(_PARTS), max_size=40).map("".join)


def one_line(error: ConfigError) -> None:
    text = str(error)
    assert text
    assert text.isprintable(), text
    assert len(text) < 2000


def checked(data: bytes) -> None:
    for model in MODELS:
        outcome = check_bytes(data, Path("f.yaml"), model)
        assert (outcome.loaded is None) == bool(outcome.errors)
        for error in outcome.errors:
            one_line(error)


@STEADY
@given(st.binary(max_size=200))
def test_any_bytes(data: bytes) -> None:
    checked(data)
    try:
        parse_document(data, file="f.yaml")
    except ConfigError as error:
        one_line(error)


@STEADY
@given(YAML_TEXT)
@example("%YAML 1\n---\na: 1")
@example("%TAG ! ! !\n---\na: !x 1")
@example("a: &a\n  b: *a")
@example('a: "\\U00110000"')
def test_any_yaml_like_text(text: str) -> None:
    checked(text.encode("utf-8", "surrogatepass"))


def _keys_of(model: type[FileModel]) -> list[str]:
    """Every key that occurs anywhere in the models."""
    found: dict[str, None] = {}
    waiting = [model]
    while waiting:
        current = waiting.pop()
        found.update(dict.fromkeys(accepted_keys([current])))
        for field in current.model_fields.values():
            waiting.extend(models_in(field.annotation))  # type: ignore[arg-type]
    return list(found)


WORDS = sorted({key for model in MODELS for key in _keys_of(model)})
_TEXTS = (
    *("bag", "synthetic", "record", "robot", "auto", "control", "zero", "<one>", "<list>", ".*", "(", "/a", "{self}"),
    *("tcp://*:1", "tcp://[::1]:5555", "ipc://x", "public", "secret", "2026-01-01T00:00:00Z", "0001-01-01T00:00+23:59"),
)
VALUES = (
    st.none()
    | st.booleans()
    | st.integers(-(1 << 70), 1 << 70)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=12)
    | st.sampled_from(_TEXTS)
)
TREES = st.recursive(
    VALUES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(WORDS) | st.text(max_size=4), inner),
    max_leaves=25,
)


@STEADY
@given(st.dictionaries(st.sampled_from(WORDS), TREES, max_size=6))
@example({"endpoint": {"kind": "bag", "bag": 1, "<one>": 2}})
@example({"client": {"kind": "name", "name": 5}})
@example({"relay": {"listen": ["tcp://[::1%x]:1", "tcp://[]:1", 3]}})
@example({"topics": [{"match": "[[a]"}, {"match": "a{99999999999999999999}"}, {"match": "(" * 300}]})
@example(
    {"sern_key": "public", "name": "a", "keys": [{"public_key": "%" * 40, "not_before": "0001-01-01T00:00+23:59"}]}
)
def test_any_values_in_the_known_places(data: dict[str, object]) -> None:
    checked(json.dumps(data).encode())
