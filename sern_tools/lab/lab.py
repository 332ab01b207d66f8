"""The lab itself: namespaces on two sides of a link that can be made bad, and changed while traffic runs.

    with Lab(a=["robot"], b=["relay", "site"]) as lab:      # or: async with
        lab.apply(load_profile("field-wifi"))
        relay = lab.popen("relay", ["sern-relay", "--config", "relay.yaml"])
        lab.change(rate_bps=1e6, loss=0.05)                 # both directions
        lab.change("up", delay_s=0.25)
        lab.blackout(True)

`up` is from side a to side b, as from a robot to its relay. What netem cannot say exactly is told in
`sern_sim.netem`; here a direction always has a rate (100 Gbit/s when none is given), so that jitter does not reorder.
"""

import asyncio
import itertools
import os
import re
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, Self, TypedDict, TypeVar, Unpack

from sern_core.vocabulary.errors import UsageError
from sern_sim.models import BurstLoss, Jitter, LinkModel
from sern_sim.netem import netem_options
from sern_sim.profiles import LinkProfile
from sern_tools.lab.backends import MIDDLE, Backend, Endpoint, Traffic, build, choose, endpoints_of
from sern_tools.lab.host import LabError, check_rights, inside
from sern_tools.lab.keeper import Keeper
from sern_tools.lab.passing import Way, await_passing
from sern_tools.lab.removal import kill_within, lock, namespace_name, sweep

Direction = Literal["both", "up", "down"]
WIRE: Final = LinkModel(queue_packets=1000)
"""The link of a new lab: nothing is done to packets."""
UNLIMITED: Final = "rate 100gbit"
STOP_S: Final = 10.0
"""Time for a process of the lab to end after SIGTERM."""
EXEC_S: Final = 60.0
_NODE: Final = re.compile(r"[a-z][a-z0-9-]{0,30}")
_numbers = itertools.count()

T = TypeVar("T")


class Changes(TypedDict, total=False):
    """The parameters of `LinkModel` that can be changed one by one."""

    rate_bps: float | None
    delay_s: float
    jitter_s: float
    jitter: Jitter
    loss: float
    burst_loss: BurstLoss | None
    reorder: float
    duplicate: float
    queue_packets: int


class Node:
    """One namespace of a lab. Sockets and processes that are in it see its loopback and the lab, nothing else."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint

    @property
    def name(self) -> str:
        return self._endpoint.name

    @property
    def namespace(self) -> str:
        """The name by which `ip netns` knows it."""
        return self._endpoint.namespace

    @property
    def address(self) -> str:
        """Its IPv4 address."""
        return self._endpoint.address

    @property
    def prefix(self) -> list[str]:
        """The words that run a command in it."""
        return ["ip", "netns", "exec", self.namespace]

    def inside(self, work: Callable[[], T]) -> T:
        """Do `work` in a thread that is in the namespace; what it raises is raised."""
        return inside(self.namespace, work)

    def socket(self, kind: socket.SocketKind = socket.SOCK_DGRAM) -> socket.socket:
        """An IPv4 socket of the namespace, for use from here. The caller closes it."""
        return self.inside(lambda: socket.socket(socket.AF_INET, kind))


class Lab:
    """`with Lab() as lab` or `async with Lab() as lab`: made on entering, removed on leaving, whatever happened.

    `a` and `b` name the namespaces on the two sides. `backend` is `native`, `appliance` or None for the first that
    works. `congestion` is the TCP congestion control in them (None: the machine's).
    Raises UsageError for impossible names, LabError (one line: what is missing) when it cannot be made.
    """

    def __init__(
        self,
        a: Iterable[str] = ("a",),
        b: Iterable[str] = ("b",),
        *,
        backend: str | None = None,
        congestion: str | None = "cubic",
    ) -> None:
        number = next(_numbers)
        self.id: Final = f"{os.getpid()}.{number}" if number else str(os.getpid())
        """`sern lab` calls it by this name."""
        sides = [list(a), list(b)]
        _check_names(sides)
        self._endpoints = endpoints_of(self.id, sides)
        self._nodes = {end.name: Node(end) for end in self._endpoints}
        self._wanted = backend
        self._congestion = congestion
        self._backend: Backend | None = None
        self._keeper: Keeper | None = None
        self._lock = -1
        self._processes: list[subprocess.Popen[Any]] = []
        self._models = [WIRE, WIRE]
        self._dark = [False, False]
        self._shaped_normal = [False, False]
        self._change = threading.RLock()

    # --- life -------------------------------------------------------------------------------------------------------

    def start(self) -> Self:
        """Make it, after removing what dead processes have left. Returns when datagrams get through both ways.

        A lab that could not be made is removed again.
        """
        check_rights()
        try:
            sweep()
            self._lock = lock(self.id)
            chosen = choose(self.id, self._wanted)
            self._keeper = Keeper(self.id)
            middle = namespace_name(self.id, MIDDLE)
            build(middle, self._endpoints, self._congestion, lock=self._lock)
            self._backend = chosen(middle)
            self._backend.start()
            self.reset()
            self._await_passing()
            self.reset()  # nothing has been carried yet
        except BaseException:
            self.close()
            raise
        return self

    def _await_passing(self) -> None:
        """Wait until datagrams pass between each node and the first of the other side."""
        left, right = ([self[end.name] for end in self._endpoints if end.side == side] for side in (0, 1))
        across = [(one, other) for one in left for other in right if one is left[0] or other is right[0]]
        with ExitStack() as stack:
            sockets = {node: stack.enter_context(node.socket()) for node in self.nodes}
            for node, sock in sockets.items():
                sock.bind((node.address, 0))
            await_passing(
                [
                    Way(f"{source.name} to {target.name}", sockets[source], sockets[target])
                    for one, other in across
                    for source, target in ((one, other), (other, one))
                ]
            )

    def close(self) -> None:
        """End its processes and remove it. Does nothing the second time. LabError when something stays behind."""
        try:
            self.stop_processes()
            if self._backend is not None:
                self._backend.stop()
        finally:
            self._backend = None
            keeper, self._keeper = self._keeper, None
            try:
                if keeper is not None:
                    keeper.release()
            finally:
                if self._lock >= 0:
                    os.close(self._lock)
                    self._lock = -1
                    if keeper is None:
                        sweep()  # only its lock was taken

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self.close()

    async def __aenter__(self) -> Self:
        return await _finish(self.start, self.close)

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        await _finish(self.close)

    # --- namespaces and processes -------------------------------------------------------------------------------------

    @property
    def nodes(self) -> list[Node]:
        """Side a first."""
        return list(self._nodes.values())

    @property
    def a(self) -> Node:
        """The first on side a."""
        return next(self._nodes[end.name] for end in self._endpoints if end.side == 0)

    @property
    def b(self) -> Node:
        """The first on side b."""
        return next(self._nodes[end.name] for end in self._endpoints if end.side == 1)

    @property
    def backend(self) -> str:
        """Which one was chosen."""
        return self._running.name

    @property
    def _running(self) -> Backend:
        if self._backend is None:
            raise LabError("the lab is not running")
        return self._backend

    def __getitem__(self, name: str) -> Node:
        if name not in self._nodes:
            raise UsageError(f"no node {name!r} in this lab; there are: {', '.join(self._nodes)}")
        return self._nodes[name]

    def _node(self, node: Node | str) -> Node:
        return self[node] if isinstance(node, str) else node

    def exec(
        self, node: Node | str, command: Sequence[str | Path], *, timeout_s: float = EXEC_S
    ) -> subprocess.CompletedProcess[str]:
        """Run a command in a namespace to its end; output and errors are captured, the exit status is the caller's."""
        return subprocess.run(
            [*self._node(node).prefix, *command],
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s, check=False,
        )  # fmt: skip

    def popen(self, node: Node | str, command: Sequence[str | Path], **options: Any) -> subprocess.Popen[Any]:
        """Start a command in a namespace; `options` are those of `subprocess.Popen`. It ends with the lab at the
        latest, also when this process is killed."""
        process: subprocess.Popen[Any] = subprocess.Popen([*self._node(node).prefix, *command], **options)
        self._processes.append(process)
        return process

    def stop_processes(self) -> None:
        """SIGTERM to what `popen` started, SIGKILL to who does not go and to whatever else is in the namespaces."""
        for process in self._processes:
            if process.poll() is None:
                process.terminate()
        give_up_s = time.monotonic() + STOP_S
        for process in self._processes:
            try:
                process.wait(max(0.0, give_up_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes.clear()
        kill_within([end.namespace for end in self._endpoints])

    # --- the link ---------------------------------------------------------------------------------------------------

    @property
    def up(self) -> LinkModel:
        """What side a to side b is like now, blackouts apart."""
        return self._models[0]

    @property
    def down(self) -> LinkModel:
        return self._models[1]

    @property
    def dark(self) -> tuple[bool, bool]:
        """Whether up and down are blacked out."""
        return self._dark[0], self._dark[1]

    def link(self, up: LinkModel | None = None, down: LinkModel | None = None) -> None:
        """Give a direction a new model; None leaves it as it is. What is in its queue stays there.

        Takes effect within about 0.1 s. A script in the model (steps, blackouts) is not played: see `run_profile`.
        """
        with self._change:
            self._shape((up or self.up, down or self.down), self.dark)

    def change(self, direction: Direction = "both", **changes: Unpack[Changes]) -> None:
        """Change single parameters and keep the others. Raises UsageError when a value makes no sense."""
        with self._change:
            self._shape(
                [replace(model, **changes) if chosen else model for model, chosen in self._chosen(direction)], self.dark
            )

    def blackout(self, on: bool, direction: Direction = "both") -> None:
        """Lose everything, or carry again. What was in the queue still leaves it, as from a real one."""
        with self._change:
            chosen = [chosen for _, chosen in self._chosen(direction)]
            dark = [on if mine else was for mine, was in zip(chosen, self._dark, strict=True)]
            self._shape(self._models, dark)

    def reset(self) -> None:
        """An unshaped link again, with an empty queue and statistics of zero."""
        with self._change:
            backend = self._running
            for device in backend.devices:
                try:
                    backend.tc([f"qdisc delete dev {device} root"])
                except LabError:
                    continue  # it has none yet
            self._shaped_normal = [False, False]
            self._shape((WIRE, WIRE), (False, False))

    def apply(self, profile: LinkProfile, *, at_s: float = 0.0) -> None:
        """Make the link what a profile says for `at_s` of its script, and leave it so."""
        with self._change:
            up, down = (replace(m, rate_bps=m.rate_bps_at(at_s), rate_steps=()) for m in (profile.up, profile.down))
            self._shape((up, down), (profile.up.blackout_at(at_s), profile.down.blackout_at(at_s)))

    def run_profile(
        self, profile: LinkProfile, *, until_s: float | None = None, stop: threading.Event | None = None
    ) -> None:
        """Play a profile's script in real time, for `until_s` (default: its `duration_s`) or until `stop` is set."""
        stop = stop or threading.Event()
        began_s = time.monotonic()
        for at_s in _moments(profile, until_s):
            if stop.wait(max(0.0, began_s + at_s - time.monotonic())):
                return
            self.apply(profile, at_s=at_s)
        stop.wait(max(0.0, began_s + _end_s(profile, until_s) - time.monotonic()))

    async def play(self, profile: LinkProfile, *, until_s: float | None = None) -> None:
        """`run_profile` beside other tasks; cancel it to stop."""
        began_s = time.monotonic()
        for at_s in _moments(profile, until_s):
            await asyncio.sleep(began_s + at_s - time.monotonic())
            await _finish(partial(self.apply, profile, at_s=at_s))
        await asyncio.sleep(began_s + _end_s(profile, until_s) - time.monotonic())

    def traffic(self) -> tuple[Traffic, Traffic]:
        """What up and down have carried since `reset`."""
        return self._running.traffic()

    def _chosen(self, direction: Direction) -> list[tuple[LinkModel, bool]]:
        if direction not in ("both", "up", "down"):
            raise UsageError(f"no direction {direction!r}: give up, down or both")
        return [(self.up, direction != "down"), (self.down, direction != "up")]

    def _shape(self, models: Sequence[LinkModel], dark: Sequence[bool]) -> None:
        lines = []
        shaped_normal = []
        for device, model, gone, was_normal in zip(
            self._running.devices, models, dark, self._shaped_normal, strict=True
        ):
            normal = bool(model.jitter_s) and model.jitter is Jitter.NORMAL
            if was_normal and model.jitter_s and not normal:
                lines.append(f"qdisc delete dev {device} root")  # the only way to be rid of a distribution
            lines.append(f"qdisc replace dev {device} root netem {shaping(model, dark=gone)}")
            shaped_normal.append(normal or (was_normal and not model.jitter_s))
        self._running.tc(lines)
        self._models, self._dark, self._shaped_normal = list(models), list(dark), shaped_normal


def shaping(model: LinkModel, *, dark: bool = False) -> str:
    """netem's options for a model without its script; `dark` loses everything."""
    plain = replace(model, rate_steps=(), blackouts=(), flap=None)
    if dark:
        plain = replace(plain, loss=1.0, burst_loss=None)
    options = netem_options(plain, 0.0)
    return options if plain.rate_bps is not None else f"{options} {UNLIMITED}"


def _moments(profile: LinkProfile, until_s: float | None) -> Iterator[float]:
    """When the script changes something, from 0 on."""
    at_s: float | None = 0.0
    while at_s is not None and at_s < _end_s(profile, until_s):
        yield at_s
        at_s = profile.next_change_s(at_s)


def _end_s(profile: LinkProfile, until_s: float | None) -> float:
    return profile.duration_s if until_s is None else until_s


def _check_names(sides: Sequence[Sequence[str]]) -> None:
    names = [name for side in sides for name in side]
    if not all(sides):
        raise UsageError("a lab needs a namespace on each side: give a name for a and one for b")
    for name in names:
        if not _NODE.fullmatch(name) or name in (MIDDLE, "probe"):
            raise UsageError(f"{name!r} cannot name a node: lower-case letters, digits, hyphens; not link or probe")
    if len(set(names)) < len(names):
        raise UsageError(f"two nodes have the same name: {', '.join(names)}")


async def _finish(work: Callable[[], T], undo: Callable[[], object] | None = None) -> T:
    """Do blocking work beside the loop, to its end even when the task is cancelled; `undo` it then."""
    task = asyncio.ensure_future(asyncio.to_thread(work))
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.wait([task])
        if undo is not None and task.exception() is None:
            await asyncio.to_thread(undo)
        raise
