"""The table of connections on which a client has spoken."""

from types import SimpleNamespace
from typing import Any

from sern_core.vocabulary.types import ClientName
from sern_relay.connections import ClientConnection, ClientConnections, Served
from sern_runtime.monitor import Connection


class Table:
    """The sockets there are, by number."""

    def __init__(self) -> None:
        self.open: dict[int, Connection] = {}

    def by_fd(self, fd: int) -> Connection | None:
        return self.open.get(fd)

    def handles(self) -> list[Any]:
        return [connection.handle for connection in self.open.values()]


def add(clients: ClientConnections, table: Table, fd: int, *, served: bool = True) -> ClientConnection:
    handle: Any = SimpleNamespace(fd=fd)
    port: Any = SimpleNamespace()
    accepted = table.open[fd] = Connection(handle, "", 0.0)
    connection = ClientConnection(
        b"%d" % fd, ClientName("robot"), "robot key", fd, accepted, Served(port, port) if served else None
    )
    clients.add(connection)
    return connection


def test_each_kind_is_found_in_the_order_in_which_it_came() -> None:
    table: Any = Table()
    clients = ClientConnections(table)
    first, control, second = (add(clients, table, fd, served=fd != 2) for fd in (1, 2, 3))
    assert [connection for connection, _served in clients.sessions()] == [first, second]
    assert clients.for_control() == [control] and clients.get(b"2") is control
    assert clients.remove(b"2") is control and clients.remove(b"2") is None and clients.for_control() == []
    clients.clear()
    assert clients.get(b"1") is None and list(clients.sessions()) == []


def test_a_socket_that_ended_or_is_anothers_by_now_is_lost() -> None:
    table: Any = Table()
    clients = ClientConnections(table)
    first, second, third = (add(clients, table, fd) for fd in (1, 2, 3))
    assert clients.lost() == []
    del table.open[1]
    table.open[2] = Connection(None, "", 0.0)
    assert clients.lost() == [first, second] and clients.get(b"3") is third


def test_what_came_out_of_every_socket_is_told_also_of_those_that_have_not_spoken() -> None:
    table: Any = Table()
    clients = ClientConnections(table)
    add(clients, table, 1).taken = 5
    add(clients, table, 2, served=False).taken = 7
    handle: Any = SimpleNamespace(fd=3)
    table.open[3] = Connection(handle, "", 0.0)
    assert {each.fd: taken for each, taken in clients.taken()} == {1: 5, 2: 7, 3: 0}
