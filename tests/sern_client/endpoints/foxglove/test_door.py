"""Who gets in: pages of which places, with which token, over TLS, and what is answered to others."""

import asyncio
import ssl
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import pytest
import websockets
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from sern_client.endpoints.foxglove import door, handshake
from sern_client.endpoints.foxglove.handshake import Turned
from sern_core.vocabulary.errors import ConfigError
from sern_runtime.config.client import ClientFile, load_client
from sern_runtime.config.load import check
from tests.support import until
from tests.viewers import bridge, head, viewer

TOKEN = "0123456789abcdef"


async def answer(port: int, sent: bytes) -> bytes:
    """All that is answered to some bytes, to the end of the connection."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(sent)
        return await reader.read()
    finally:
        writer.close()
        await writer.wait_closed()


@pytest.mark.parametrize(
    "origin",
    [None, "https://app.foxglove.dev", "file://", "http://localhost:8080", "http://127.0.0.1:9", "https://[::1]:8080"],
)
async def test_pages_that_get_in(origin: str | None) -> None:
    async with bridge() as run, viewer(run.port, origin=origin) as person:
        assert person.connection.subprotocol == "foxglove.sdk.v1"


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "null", "http://127.0.0.1.evil.example", "https://app.foxglove.dev.evil.example", "http://[",
     "http://10.0.0.1", "", "http://localhost.evil.example:8765"],
)  # fmt: skip
async def test_pages_that_do_not(origin: str) -> None:
    async with bridge() as run:
        said = await answer(run.port, head(Origin=origin))
        assert said.startswith(b"HTTP/1.1 403 ") and b"name it in origins, or set a token" in said
        assert run.endpoint.shared.turned == {Turned.ORIGIN: 1}


async def test_a_page_that_is_named_and_one_that_has_the_token() -> None:
    async with bridge(origins=("https://lichtblick.example",)) as run:
        async with viewer(run.port, origin="https://Lichtblick.example"):
            pass
        assert (await answer(run.port, head(Origin="https://app.foxglove.dev"))).startswith(b"HTTP/1.1 403 ")
    async with bridge(token=TOKEN) as run, viewer(run.port, origin="https://any.example", query=f"?token={TOKEN}"):
        pass


@pytest.mark.parametrize("target", ["/", "/?token=", "/?token=wrong", f"/?token={TOKEN}x", f"/{TOKEN}", "/?token=%ff"])
async def test_without_the_token(target: str, caplog: pytest.LogCaptureFixture) -> None:
    async with bridge(token=TOKEN) as run:
        said = await answer(run.port, head(target=target))
        assert said.startswith(b"HTTP/1.1 401 ") and b"the address ends with /?token=TOKEN" in said
        assert run.endpoint.shared.turned == {Turned.TOKEN: 1}
    assert TOKEN not in caplog.text and "wrong" not in caplog.text.replace("is wrong", "")


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"426"),
        (b"POST / HTTP/1.1\r\n\r\n", b"400"),
        (b"\x16\x03\x01\x02\x00\x01", b"400"),
        (b"GET / HTTP/1.0\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\nno header\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\n: x\r\n\r\n", b"400"),
        (b"GET /\xff HTTP/1.1\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\n" + b"x: y\r\n" * 5_000, b"400"),
        (b"GET / HTTP/1.1\r\nOrigin: file://\r\nOrigin: https://evil.example\r\n\r\n", b"400"),
        (head(Sec_WebSocket_Protocol="chat"), b"400"),
        (head(drop=("Sec-WebSocket-Key",)), b"426"),
    ],
    ids=["browser", "post", "tls", "old", "header", "no_name", "not_ascii", "long", "two_origins", "protocol", "key"],
)
async def test_what_is_no_request_of_a_viewer(sent: bytes, status: bytes) -> None:
    async with bridge() as run:
        assert (await answer(run.port, sent)).startswith(b"HTTP/1.1 " + status)
        async with viewer(run.port) as person:
            assert person.info["name"] == "SERN"
        await until(lambda: not run.endpoint.shared.viewers)


async def test_who_says_nothing_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(door, "HANDSHAKE_S", 0.05)
    async with bridge() as run:
        assert await answer(run.port, b"GET / HT") == b""
        assert run.endpoint.shared.turned == {Turned.REQUEST: 1}


async def test_as_many_as_there_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(door, "MAX_VIEWERS", 1)
    async with bridge() as run:
        async with viewer(run.port):
            said = await answer(run.port, head())
            assert said.startswith(b"HTTP/1.1 503 ") and b"1 viewers are connected already" in said
        await until(lambda: not run.endpoint.shared.viewers)
        async with viewer(run.port):
            pass


async def test_the_server_gets_no_token() -> None:
    request = handshake.read(head(target=f"/?token={TOKEN}", Origin="https://a.example", Cookie="c") + b"rest")
    assert request is not None and request.rest == b"rest"
    passed = handshake.passed_on(request, "127.1.2.3:4")
    assert TOKEN.encode() not in passed and b"Cookie" not in passed and b"sec-websocket-key: " in passed


async def test_a_port_that_is_taken() -> None:
    async with bridge() as run:
        with pytest.raises(ConfigError, match=r"cannot listen on 127\.0\.0\.1:[0-9]+ for viewers: .*; choose another"):
            async with bridge(listen=f"127.0.0.1:{run.port}"):
                raise AssertionError("two listen on one port")


async def test_its_end_is_told_to_one_who_has_the_older_name_of_the_protocol() -> None:
    async with bridge() as run:
        connection = await websockets.connect(
            f"ws://127.0.0.1:{run.port}", subprotocols=[websockets.Subprotocol("foxglove.websocket.v1")], proxy=None
        )
        assert connection.subprotocol == "foxglove.websocket.v1"
        await connection.recv()
    await connection.wait_closed()
    assert connection.close_code == 1001


@pytest.fixture
def certificate(tmp_path: Path) -> tuple[Path, Path]:
    """A certificate for 127.0.0.1 and its key, as files."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "site1")])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
        .serial_number(x509.random_serial_number()).not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ip_address("127.0.0.1"))]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )  # fmt: skip
    paths = tmp_path / "cert.pem", tmp_path / "key.pem"
    paths[0].write_bytes(made.public_bytes(serialization.Encoding.PEM))
    paths[1].write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return paths


async def test_over_tls(certificate: tuple[Path, Path]) -> None:
    context = ssl.create_default_context(cafile=str(certificate[0]))
    async with bridge(tls_certificate=certificate[0], tls_key=certificate[1], token=TOKEN) as run:
        async with viewer(run.port, tls=context, query=f"?token={TOKEN}") as person:
            assert person.info["name"] == "SERN"
        assert b"SERN" not in await answer(run.port, head())
    with pytest.raises(ConfigError, match="cannot be used for TLS"):
        async with bridge(tls_certificate=certificate[1], tls_key=certificate[0]):
            raise AssertionError("a key is no certificate")


def test_the_file_is_checked_with_its_certificate(certificate: tuple[Path, Path], tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    before = (
        "client: {name: site1}\nrelay: {endpoint: 'tcp://127.0.0.1:5555', insecure: true}\n"
        f"endpoint: {{kind: foxglove, listen: '0.0.0.0:8765', token: {TOKEN}, "
    )
    path.write_text(before + "tls_certificate: cert.pem, tls_key: key.pem}\n")
    assert load_client(path).model.endpoints[0].kind == "foxglove"
    path.write_text(before + "tls_certificate: cert.pem, tls_key: none.pem}\n")
    assert [str(error) for error in check(path, ClientFile).errors] == [
        f"{path}:3: endpoint.tls_key: {tmp_path / 'none.pem'}: no such file"
    ]
    path.write_text(before + "tls_certificate: key.pem, tls_key: cert.pem}\n")
    (error,) = check(path, ClientFile).errors
    assert "cannot be used" in str(error) and "\n" not in str(error)
