"""The core that is tested is the one that was asked for: `make test-compiled` says so in SERN_CORE."""

import os

from sern_runtime import version


def test_the_core_is_compiled_if_that_was_asked_for() -> None:
    assert version.compiled() == (os.environ.get("SERN_CORE") == "compiled")
