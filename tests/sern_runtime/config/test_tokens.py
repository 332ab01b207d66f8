"""Files with a token."""

from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.config.client import load_client
from sern_runtime.config.relay import load_relay
from sern_runtime.config.tokens import MAX_CHARS, read_token

TOKEN = "0123456789abcdef"


def written(directory: Path, content: bytes, mode: int = 0o600) -> Path:
    path = directory / "http.token"
    path.write_bytes(content)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("end", [b"", b"\n", b"\r\n"])
def test_a_token_is_one_line(tmp_path: Path, end: bytes) -> None:
    assert read_token(written(tmp_path, TOKEN.encode() + end)) == TOKEN
    long = "x" * MAX_CHARS
    assert read_token(written(tmp_path, long.encode() + end)) == long


@pytest.mark.parametrize(
    "content",
    [
        b"", b"\n", b"short", b"0123456789abcdef\n\n", b"0123456789 abcdef", b"0123456789abcdef\nanother0123456\n",
        b"0123456789abcd\xc3\xa9f", b"\x000123456789abcdef", b"x" * (MAX_CHARS + 1), b" 0123456789abcdef",
    ],
)  # fmt: skip
def test_what_is_none_is_one_line_that_does_not_quote_it(tmp_path: Path, content: bytes) -> None:
    path = written(tmp_path, content)
    with pytest.raises(ConfigError) as caught:
        read_token(path)
    text = str(caught.value)
    assert text.startswith(f"{path} holds no token: ") and "openssl rand" in text and "\n" not in text
    assert "0123456789" not in text


def test_a_file_that_is_not_there_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"http.token: no such file or directory; make one with \(umask 077"):
        read_token(tmp_path / "http.token")


CLIENT = """\
client: {{name: robot1}}
relay: {{endpoint: "tcp://127.0.0.1:5555", insecure: true}}
endpoint: {{kind: synthetic, role: robot}}
http: {http}
"""
RELAY = """\
relay: {{name: hub, listen: ["tcp://127.0.0.1:5555"], insecure: true}}
http: {http}
"""


@pytest.mark.parametrize("kind", ["client", "relay"])
def test_beyond_loopback_a_token_is_needed(tmp_path: Path, kind: str) -> None:
    load, text = (load_client, CLIENT) if kind == "client" else (load_relay, RELAY)
    path = tmp_path / f"{kind}.yaml"

    def said(http: str) -> str:
        path.write_text(text.format(http=http))
        with pytest.raises(ConfigError) as caught:
            load(path)
        return str(caught.value)

    for listen in ("0.0.0.0:5580", "10.8.0.2:5580", "[::]:5580"):
        assert "http.listen: " in said(f'{{listen: "{listen}"}}')
        assert f"{listen} is open to the network: set http.token_file, or listen on" in said(f'{{listen: "{listen}"}}')
    assert "http.token_file: " in said('{listen: "0.0.0.0:5580", token_file: http.token}')
    written(tmp_path, TOKEN.encode())
    path.write_text(text.format(http='{listen: "0.0.0.0:5580", token_file: http.token}'))
    loaded = load(path)
    assert loaded.warnings == ()
    access = loaded.model.http.access(tmp_path)
    assert access.refusal("/api/link", None, f"Bearer {TOKEN}") is None
    assert access.refusal("/api/link", None, None) is not None
    written(tmp_path, TOKEN.encode(), 0o644)
    (warning,) = load(path).warnings
    assert "open to others than its owner (mode 0644); run: chmod 600" in warning
