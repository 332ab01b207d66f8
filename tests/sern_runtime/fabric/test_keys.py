"""Keys of the fabric: there and back, and what is none of ours."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import CLASSES, ClientName, PriorityClass
from sern_runtime.fabric import keys
from sern_runtime.fabric.port import PeerRelay

NAMES = st.from_regex(r"[a-z][a-z0-9_]{0,62}", fullmatch=True).map(ClientName)
BOOTS = st.integers(0, 2**63 - 1)


@given(NAMES, BOOTS, st.integers(0, 255), st.integers(0, 255), st.just("") | st.binary(min_size=1).map(bytes.hex))
def test_a_relay_there_and_back(name: ClientName, boot: int, low: int, high: int, rules: str) -> None:
    relay = PeerRelay(name, boot, (low, high), rules[:128])
    assert keys.parse_token(keys.relay_token(relay)) == relay


@given(NAMES, NAMES, st.sampled_from(CLASSES))
def test_a_datagram_is_of_the_relay_in_its_key(own: ClientName, other: ClientName, priority: PriorityClass) -> None:
    assert keys.parse_source(keys.hop_key(own, other, priority), own) == other


@given(st.text(max_size=80))
def test_what_is_no_key_of_ours_is_nobody(text: str) -> None:
    own = ClientName("me")
    for key in (text, f"{keys.ROOT}/{text}", f"{keys.ROOT}/h/me/{text}", f"{keys.ROOT}/relay/{text}"):
        source, token = keys.parse_source(key, own), keys.parse_token(key)
        assert source is None or key in {keys.hop_key(own, source, priority) for priority in CLASSES}
        assert token is None or keys.relay_token(token) == key


@pytest.mark.parametrize("key", ["me/you/0", "relay/you/1/1/1/-", "at/robot/you/1/1", "sern/2/h/me/you/0"])
def test_what_is_under_another_root_is_not_read(key: str) -> None:
    assert keys.parse_source(key, ClientName("me")) is None
    assert keys.parse_token(key) is None


@pytest.mark.parametrize("name", ["*", "**", "a/b", "a$*", "a#b", "a?x", "", "A", "é", "-"])
def test_a_name_that_means_something_in_a_key_expression_is_refused(name: str) -> None:
    bad, good = ClientName(name), ClientName("relay")
    makers: list[Callable[[], str]] = [
        lambda: keys.hop_key(bad, good, PriorityClass.BULK),
        lambda: keys.hop_key(good, bad, PriorityClass.BULK),
        lambda: keys.inbox(bad),
        lambda: keys.relay_token(PeerRelay(bad, 1, (1, 1), "")),
    ]
    for make in makers:
        with pytest.raises(UsageError, match="client name"):
            make()
