"""What a client says of a handshake without an end: a wrong key is named first only where a relay was there."""

import errno

import pytest

from sern_runtime import transport_watch
from sern_runtime.transport_watch import CUT, ENDED, GREETING_BYTES, HALF_WAY, SHUT, SILENT, UNFINISHED, _unfinished

KEY = "server_key_file"


@pytest.mark.parametrize(
    ("received", "timed_out", "closed"),
    [
        (0, SILENT, SHUT),
        (1, SILENT, SHUT),  # the end of the stream counts as one
        (12, UNFINISHED, SHUT),  # a relay says all of its greeting at once
        (GREETING_BYTES - 1, UNFINISHED, SHUT),
        (GREETING_BYTES, HALF_WAY, ENDED),
        (1000, HALF_WAY, ENDED),
        (None, UNFINISHED, CUT),
    ],
)
def test_what_is_said_for_how_much_came(received: int | None, timed_out: str, closed: str) -> None:
    assert _unfinished(errno.EAGAIN, received) == timed_out
    assert {_unfinished(number, received) for number in (errno.EPIPE, errno.ECONNRESET, errno.ENOTCONN)} == {closed}


def test_the_key_is_the_first_guess_only_where_a_relay_answered() -> None:
    texts = [text for name, text in vars(transport_watch).items() if name.isupper() and isinstance(text, str)]
    assert {text for text in texts if KEY in text} == {ENDED, CUT}
    guesses = CUT.partition(": ")[2]
    assert guesses.rindex("key") > max(guesses.index("full"), guesses.index("no relay"))
    assert guesses.endswith(KEY)
