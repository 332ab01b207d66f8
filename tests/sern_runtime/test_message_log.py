"""A message log that cannot be written ends, in one line, and is counted."""

from functools import partial
from pathlib import Path

import pytest

from sern_runtime.message_log import MessageLog
from sern_runtime.optional import OptionalParts


def test_a_full_disk_ends_the_log_and_is_counted_once(caplog: pytest.LogCaptureFixture) -> None:
    parts = OptionalParts("message_log")
    log = MessageLog(Path("/dev/full"), partial(parts.ended, "message_log"))
    for _ in range(3):
        log.flush()
    log.close()
    line = "/dev/full: the message log ends here: No space left on device"
    assert caplog.messages == [line] and log.problem == line
    assert parts.failures == {"message_log": 1}
