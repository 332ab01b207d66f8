"""Local sockets: which a tool finds, and whom it does not believe."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.local_socket import LocalServer, sockets


@pytest.fixture
def session() -> Iterator[Path]:
    """A user's runtime directory, with a short name."""
    with TemporaryDirectory(prefix="sern-", dir="/tmp") as directory:
        (Path(directory) / "sern").mkdir(mode=0o700)
        yield Path(directory)


def mine(session: Path) -> set[str]:
    """The clients that a tool of this user finds there."""
    found = sockets({"XDG_RUNTIME_DIR": str(session)})
    return {name for name, path in found.items() if path.is_relative_to(session)}


def listening(stack: ExitStack, path: Path) -> socket.socket:
    made = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
    made.bind(str(path))
    made.listen()
    return made


def test_those_are_found_on_which_somebody_listens(session: Path) -> None:
    with ExitStack() as stack:
        listening(stack, session / "sern" / "robot1.sock")
        listening(stack, session / "sern" / "killed.sock").close()
        assert (session / "sern" / "killed.sock").exists()
        assert mine(session) == {"robot1"}


def test_a_directory_into_which_others_may_write_is_not_believed(session: Path) -> None:
    with ExitStack() as stack:
        listening(stack, session / "sern" / "robot1.sock")
        (session / "sern").chmod(0o777)
        assert mine(session) == set()


async def test_what_a_killed_daemon_has_left_is_taken_over_and_nobody_elses(session: Path) -> None:
    path = session / "sern" / "robot1.sock"
    with ExitStack() as stack:
        listening(stack, path).close()
        server = LocalServer(path, lambda request: pytest.fail(str(request)))
        await server.start()
        with pytest.raises(
            ConfigError, match=r"robot1\.sock: another daemon has it; remove it, or give one of the two"
        ):
            await LocalServer(path, lambda request: pytest.fail(str(request))).start()
        await server.stop()
    assert not path.exists()
