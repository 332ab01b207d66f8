"""A message without end: its connection is cut, what came of it is let go, and others are served meanwhile."""

import asyncio
import socket as socketlib
import threading
from pathlib import Path

import pytest
import zmq

from sern_runtime.inflow import LIMIT_BYTES, TRIM_AFTER_S, Inflow, Trimmer
from sern_runtime.monitor import ConnectionTable, TcpHandle
from sern_runtime.zmq_setup import make_client, make_server
from sern_runtime.zmq_socket import SKIP_FRAMES, DealerSocket, FrameSocket, RouterSocket
from tests.support import DEADLINE_S, until

Context = zmq.Context[zmq.Socket[bytes]]
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL".ljust(54, b"\0") + b"\0"
READY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER\x08Identity\x00\x00\x00\x00"
MANY = 2_000_000


def rss_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20


class Endless(threading.Thread):
    """Speaks ZMTP without keys, and sends one message of frames of a byte each, until it is cut off or has sent all."""

    def __init__(self, port: int, frames: int = MANY, *, body: bytes = b"x") -> None:
        super().__init__(daemon=True)
        self.port = port
        self.frames = frames
        self.piece = b"\x01" + bytes([len(body)]) + body
        self.sent_bytes = 0
        self.over = threading.Event()
        self.all_sent = threading.Event()

    def stop(self) -> None:
        self.over.set()
        self.join()

    def run(self) -> None:
        with socketlib.create_connection(("127.0.0.1", self.port)) as connection:
            connection.sendall(GREETING)
            assert connection.recv(64, socketlib.MSG_WAITALL)[:1] == b"\xff"
            connection.sendall(b"\x04" + bytes([len(READY)]) + READY)
            connection.settimeout(0.1)  # not every kernel tells a sender that its peer is gone
            while not self.over.is_set():
                try:
                    if self.sent_bytes < self.frames * len(self.piece):
                        self.sent_bytes += connection.send(self.piece * 4096)
                        continue
                    self.all_sent.set()
                    if not connection.recv(4096):
                        break
                except TimeoutError:
                    continue
                except OSError:
                    break  # cut off


class Served:
    """A ROUTER that answers, with an honest client and the watch."""

    def __init__(self, context: Context, *, period_s: float = 0.02) -> None:
        raw = make_server(context, ["tcp://127.0.0.1:*"], None)
        self.endpoint = raw.getsockopt_string(zmq.LAST_ENDPOINT)
        self.port = int(self.endpoint.rpartition(":")[2])
        self.table = ConnectionTable(raw)
        self.taken: dict[int, int] = {}
        self.refused: list[str] = []
        self.cut: list[TcpHandle] = []
        self.router = RouterSocket(raw, self._received, identified=False)
        self.router.on_refused = self._refused
        self.inflow = Inflow(
            self.router,
            lambda: [(handle, self.taken.get(handle.fd, 0)) for handle in self.table.handles()],
            self.cut.append,
            period_s=period_s,
        )
        self.answers = 0
        self.client = DealerSocket(make_client(context, self.endpoint, None, None), self._answered)

    def _received(self, routing_id: bytes, user: str, body: bytes) -> None:
        fd = self.router.peer_details().fd
        self.taken[fd] = self.taken.get(fd, 0) + 1
        self.router.send_to(routing_id, body)

    def _refused(self, why: str) -> None:
        self.refused.append(why)
        self.table.cut(self.router.peer_details().fd)

    def _answered(self, body: bytes) -> None:
        self.answers += 1

    async def ask(self) -> None:
        """A question of the honest client is answered."""
        before = self.answers
        await until(lambda: self.client.send(b"?"), "connected")
        await until(lambda: self.answers > before, "an answer")

    def close(self) -> None:
        self.inflow.close()
        self.client.close()
        self.table.close()
        self.router.close()


async def test_a_message_without_end_is_cut_and_its_memory_comes_back(zmq_context: Context) -> None:
    served = Served(zmq_context)
    await served.ask()
    before_mb = rss_mb()
    peer = Endless(served.port)
    peer.start()
    await until(lambda: served.inflow.endless + len(served.refused) == 1, "somebody noticed")
    await served.ask()
    await until(lambda: len(served.table) == 1, "the connection is gone")
    peer.stop()
    await until(lambda: rss_mb() < before_mb + 24, "the memory is back")
    await served.ask()
    assert served.inflow.endless + served.router.malformed == 1
    served.close()


async def test_its_memory_comes_back_also_when_the_loop_was_late_and_large_blocks_were_freed_before(
    zmq_context: Context,
) -> None:
    """glibc keeps more at the end of each heap after every large block that is freed."""
    served = Served(zmq_context)
    bytearray(31 * 2**20)  # freed at once
    await served.ask()
    before_mb = rss_mb()
    peer = Endless(served.port)
    peer.start()
    assert peer.all_sent.wait(DEADLINE_S)  # the loop stands still meanwhile
    await until(lambda: served.inflow.endless == 1, "noticed")
    await until(lambda: len(served.table) == 1, "the connection is gone")
    peer.stop()
    await until(lambda: rss_mb() < before_mb + 24, "the memory is back")
    await served.ask()
    served.close()


async def test_a_message_that_never_ends_is_cut_although_no_frame_of_it_is_ever_seen(zmq_context: Context) -> None:
    served = Served(zmq_context)
    await served.ask()
    peer = Endless(served.port, 100_000)  # the last frame says that more follow, too
    peer.start()
    await until(lambda: served.cut, "cut")
    peer.stop()
    assert [handle.peer[0] for handle in served.cut] == ["127.0.0.1"]
    assert served.router.malformed == 0
    await served.ask()
    served.close()


async def test_the_frames_of_an_unwanted_message_are_dropped_in_slices(
    zmq_context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = Served(zmq_context, period_s=3600.0)
    await served.ask()
    slices: list[int] = []
    taken = 0

    def skip(socket: RouterSocket) -> bool:
        nonlocal taken
        done = original(socket)
        slices.append(SKIP_FRAMES)
        return done

    original = RouterSocket._skip
    monkeypatch.setattr(RouterSocket, "_skip", skip)
    hostile = zmq_context.socket(zmq.DEALER)
    hostile.setsockopt(zmq.LINGER, 0)
    hostile.connect(served.endpoint)
    hostile.send_multipart([b"x"] * (5 * SKIP_FRAMES))
    await until(lambda: served.refused, "refused")
    await served.ask()
    assert served.refused == ["a message of several frames"]
    assert len(slices) >= 5
    assert served.router.malformed == 1
    assert not served.router.skipping
    hostile.close(linger=0)
    served.close()


@pytest.mark.parametrize("kind", ["dealer", "frames"])
async def test_other_sockets_drop_them_in_slices_too(zmq_context: Context, kind: str) -> None:
    got: list[bytes] = []
    raw = zmq_context.socket(zmq.PULL)
    raw.bind("inproc://slices")
    reader: DealerSocket | FrameSocket
    if kind == "dealer":
        reader = DealerSocket(raw, got.append)
    else:
        reader = FrameSocket(raw, lambda frames: got.append(frames[0].bytes))
    sender = zmq_context.socket(zmq.PUSH)
    sender.connect("inproc://slices")
    drains = reader.drains
    sender.send_multipart([b"no"] * (5 * SKIP_FRAMES))
    sender.send(b"yes")
    await until(lambda: got, "the next message")
    assert got == [b"yes"]
    assert reader.malformed == 1
    assert reader.drains >= drains + 5
    sender.close(linger=0)
    reader.close()


class Trims:
    """A trimmer whose times pass one by one, when the test says so."""

    def __init__(self) -> None:
        self.trims = 0
        self.delays_s: list[float] = []
        self._asleep = threading.Semaphore(0)
        self._awake = threading.Semaphore(0)
        self.trimmer = Trimmer(self._trim, self._sleep)

    def _trim(self) -> None:
        self.trims += 1

    def _sleep(self, delay_s: float) -> None:
        self.delays_s.append(delay_s)
        self._asleep.release()
        assert self._awake.acquire(timeout=DEADLINE_S)

    def asleep(self) -> None:
        assert self._asleep.acquire(timeout=DEADLINE_S)

    def wake(self) -> None:
        self._awake.release()


async def test_memory_that_is_freed_late_is_given_back_too() -> None:
    trims = Trims()
    trims.trimmer()
    for number in range(len(TRIM_AFTER_S)):
        trims.asleep()
        assert trims.trims == number
        trims.wake()
    await until(lambda: trims.trims == len(TRIM_AFTER_S), "trimmed")
    assert trims.delays_s == list(TRIM_AFTER_S)


async def test_the_times_of_giving_back_count_anew_when_more_was_cut() -> None:
    trims = Trims()
    trims.trimmer()
    trims.asleep()
    trims.wake()
    trims.asleep()
    trims.trimmer()
    for _ in TRIM_AFTER_S:
        trims.wake()
        trims.asleep()
    trims.wake()
    await until(lambda: trims.trims == 2 + len(TRIM_AFTER_S), "trimmed")
    assert trims.delays_s == [*TRIM_AFTER_S[:2], *TRIM_AFTER_S]


class FakeHandle:
    """A connection on which bytes were read."""

    def __init__(self) -> None:
        self.read: int | None = 0
        self.gone = False

    def read_bytes(self) -> int | None:
        return self.read

    def cut(self) -> bool:
        self.gone = True
        return True


class FakeSocket:
    def __init__(self) -> None:
        self.messages = 0
        self.emptied = 0
        self.empty = True

    def drain(self) -> None:
        self.emptied += self.empty


class Looks:
    """An `Inflow` over one connection, looked at by hand."""

    def __init__(self) -> None:
        self.socket = FakeSocket()
        self.handle = FakeHandle()
        self.listed = True
        self.taken = 0
        self.now = 0.0
        self.inflow = Inflow(self.socket, self._connections, lambda _: None, period_s=3600.0, clock=lambda: self.now)

    def _connections(self) -> list[tuple[FakeHandle, int]]:
        return [(self.handle, self.taken)] if self.listed else []

    def look(self, read: int | None, *, taken: int = 0, after_s: float = 0.05) -> bool:
        self.now += after_s
        self.handle.read = read
        self.taken += taken
        self.socket.messages += taken
        self.inflow.look(now=self.now)
        return self.handle.gone


async def test_large_messages_that_come_out_are_no_reason() -> None:
    looks = Looks()
    assert not any(looks.look(number * 10**6, taken=1) for number in range(50))
    looks.inflow.close()


async def test_bytes_without_a_message_are() -> None:
    looks = Looks()
    looks.look(0)
    looks.look(LIMIT_BYTES + 1000)
    assert not looks.handle.gone  # they may be of messages that come out now
    assert looks.look(LIMIT_BYTES + 1000)
    assert looks.inflow.endless == 1
    looks.inflow.close()


async def test_a_connection_is_ended_once_although_libzmq_reads_on() -> None:
    """What had arrived is read after the cut, too, and the connection is listed until then."""
    looks = Looks()
    looks.look(0)
    looks.look(LIMIT_BYTES + 1000)
    assert looks.look(LIMIT_BYTES + 1000)
    for number in range(2, 10):
        looks.look(number * 2 * LIMIT_BYTES)
    assert looks.inflow.endless == 1
    looks.listed = False  # it is gone; another one has its number
    looks.look(0)
    looks.listed, looks.handle.gone = True, False
    looks.look(0)
    looks.look(LIMIT_BYTES + 1000)
    assert looks.look(LIMIT_BYTES + 1000)
    assert looks.inflow.endless == 2
    looks.inflow.close()


async def test_what_waits_for_us_is_not_the_connections_fault() -> None:
    looks = Looks()
    looks.look(0)
    looks.socket.empty = False  # the loop is behind with others' messages
    assert not any(looks.look(number * LIMIT_BYTES) for number in range(1, 10))
    looks.socket.empty = True
    assert not looks.look(10 * LIMIT_BYTES)
    assert not looks.look(10 * LIMIT_BYTES, taken=3)  # they were waiting
    assert not looks.look(10 * LIMIT_BYTES)
    looks.inflow.close()


async def test_a_flood_from_elsewhere_hides_nothing() -> None:
    looks = Looks()
    looks.look(0)
    looks.socket.empty = False
    for number in range(1, 4):
        looks.socket.messages += 100  # everybody had a turn
        looks.look(number * LIMIT_BYTES)
    assert looks.handle.gone
    looks.inflow.close()


async def test_heartbeats_of_an_idle_connection_are_no_message() -> None:
    looks = Looks()
    looks.look(0)
    assert not any(looks.look(second * 120, after_s=1.0) for second in range(24 * 3600))
    looks.inflow.close()


async def test_where_the_kernel_says_nothing_nothing_is_done() -> None:
    looks = Looks()
    assert not any(looks.look(None) for _ in range(5))
    looks.inflow.close()


async def test_what_was_read_is_what_arrived_less_what_waits(zmq_context: Context) -> None:
    with socketlib.create_server(("127.0.0.1", 0)) as server:
        with socketlib.create_connection(server.getsockname()) as client:
            accepted, _ = server.accept()
            with accepted:
                handle = TcpHandle.of(accepted.fileno())
                assert handle is not None
                client.sendall(bytes(3000))
                accepted.recv(1000, socketlib.MSG_WAITALL)
                await until(lambda: handle.read_bytes() == 1000, "the kernel has counted")
                accepted.recv(2000, socketlib.MSG_WAITALL)
                assert handle.read_bytes() == 3000
                assert accepted.fileno() >= 0  # still ours
        assert handle.read_bytes() is None
    await asyncio.sleep(0)
