"""Who may ask over HTTP: with a token, and without one."""

import pytest

from sern_runtime.http_access import HttpAccess

TOKEN = "0123456789abcdef"


@pytest.mark.parametrize(
    "authorization", [f"Bearer {TOKEN}", f"bearer {TOKEN}", f"BEARER  {TOKEN} "], ids=["usual", "lower", "spaces"]
)
def test_who_sends_the_token_may_ask_by_any_name(authorization: str) -> None:
    access = HttpAccess(TOKEN)
    assert access.refusal("/api/link", "van.example:5580", authorization) is None
    assert access.refused == {"token": 0, "host": 0}


WRONG = {
    "none": None,
    "empty": "",
    "scheme alone": "Bearer",
    "no token": "Bearer ",
    "token alone": TOKEN,
    "another scheme": f"Basic {TOKEN}",
    "too long": f"Bearer {TOKEN}x",
    "too short": f"Bearer {TOKEN[:-1]}",
    "in upper case": f"Bearer {TOKEN.upper()}",
    "bytes that are no text": "Bearer \udcff\udcfe",
}


@pytest.mark.parametrize("name", WRONG)
def test_who_does_not_is_refused_with_one_line(name: str) -> None:
    authorization = WRONG[name]
    access = HttpAccess(TOKEN)
    access.let_in("/healthz")
    refusal = access.refusal("/api/link", "127.0.0.1:5580", authorization)
    assert refusal is not None
    assert refusal.status == 401
    assert "\n" not in refusal.text and TOKEN not in refusal.text
    assert access.refused == {"token": 1, "host": 0}
    assert access.refusal("/healthz", "127.0.0.1", authorization) is None
    assert access.refusal("/healthz/", "127.0.0.1", authorization) is not None


@pytest.mark.parametrize(
    ("host", "let_in"),
    [
        ("127.0.0.1:5580", True), ("127.0.0.1", True), ("[::1]:5580", True), ("[::1]", True), ("10.8.0.2:5580", True),
        ("localhost:5580", True), ("LOCALHOST", True), ("sern.localhost:1", True), (None, True),
        ("attacker.example:5580", False), ("127.0.0.1.attacker.example", False), ("localhost.attacker.example", False),
        ("", False), ("[::1", False), ("127.0.0.1:5580:x", False), ("xlocalhost", False),
    ],
)  # fmt: skip
def test_without_a_token_a_name_that_strangers_can_point_here_is_refused(host: str | None, let_in: bool) -> None:
    access = HttpAccess()
    access.let_in("/healthz")
    refusal = access.refusal("/api/link", host, None)
    assert (refusal is None) == let_in
    assert access.refused == {"token": 0, "host": int(not let_in)}
    if refusal is not None:
        assert (refusal.status, "http.token_file" in refusal.text) == (421, True)
    assert access.refusal("/healthz", host, None) is None


def test_paths_can_be_opened_to_everybody_later() -> None:
    access = HttpAccess(TOKEN)
    access.let_in("/", "/page.css")
    assert access.refusal("/", "any.example", None) is None
    assert access.refusal("/api/live", "any.example", None) is not None
