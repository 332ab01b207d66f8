"""How a lab is wired, and the two ways to run `tc netem` in its middle.

    robot:eth0 --- bridge "left" ===( the link )=== bridge "right" --- relay:eth0
                                                             |
                                                            ... --- site:eth0

Both bridges are in a namespace of their own, as is the link, so queue and rate sit in the middle as they do on a real
path: a sender's kernel feels them through lost and late packets only. Namespaces on one side reach each other
unshaped. The link is, by backend,

- native:    a pair of virtual interfaces with netem on both, where this kernel has it;
- appliance: two taps with a guest between them (see `appliance`), elsewhere.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Self

from sern_tools.lab import appliance
from sern_tools.lab.appliance import Appliance
from sern_tools.lab.host import LabError, check_rights, missing_rights, no_offloads, quiet, run, run_all
from sern_tools.lab.removal import namespace_name

NETWORK: Final = "198.18"
"""Addresses for measurements between networks (RFC 2544, RFC 6890): 198.18.0.N on side a, 198.18.1.N on side b."""
PREFIX: Final = 16
MIDDLE: Final = "link"
"""The node between the sides; no other may have its name."""
SIDES: Final = ("left", "right")
DEVICE: Final = "eth0"
"""The one interface of every namespace beside its loopback."""
TAP_PACKETS: Final = 20_000
"""What a tap holds while the guest does not run: losses are the link's alone. The kernel's 500 are gone in a moment."""


@dataclass(frozen=True)
class Endpoint:
    """A namespace at one end: `side` is 0 for a and 1 for b, `number` counts from 1 on each side."""

    name: str
    namespace: str
    side: int
    number: int

    @property
    def address(self) -> str:
        return f"{NETWORK}.{self.side}.{self.number}"

    @property
    def hardware_address(self) -> str:
        return f"02:53:45:52:{self.side:02x}:{self.number:02x}"

    @property
    def port(self) -> str:
        """Its bridge's end of its cable."""
        return f"p{self.side}.{self.number}"


@dataclass(frozen=True)
class Traffic:
    """What one direction of the link has carried since its netem was made: `packets` and `bytes` (with Ethernet
    headers) that left it, `dropped` for want of room in its queue or as configured loss, `queued` now."""

    packets: int
    bytes: int
    dropped: int
    queued: int


class Backend(ABC):
    """The link between the bridges `left` and `right` of the namespace `middle`."""

    name: str

    def __init__(self, middle: str) -> None:
        self.middle = middle

    @classmethod
    @abstractmethod
    def missing(cls, probe: str) -> list[str]:
        """What it needs and this machine lacks. `probe`: a name for a namespace to try things in."""

    @abstractmethod
    def cable(self) -> list[str]:
        """The commands that put the link's two ends into the bridges."""

    def start(self) -> Self:
        """Called once, when the bridges stand. LabError when the link does not come up."""
        run_all(self.cable())
        return self

    @abstractmethod
    def tc(self, lines: Sequence[str]) -> str:
        """Run tc with these lines (what stands behind `tc`) in one go and return its output."""

    @property
    @abstractmethod
    def devices(self) -> tuple[str, str]:
        """The devices that up (a to b) and down leave by, where netem sits."""

    def traffic(self) -> tuple[Traffic, Traffic]:
        """Up and down."""
        found = {entry["dev"]: entry for entry in json.loads(self.statistics()) if entry.get("root")}
        up, down = (
            Traffic(entry["packets"], entry["bytes"], entry["drops"], entry["qlen"])
            for entry in (found[device] for device in self.devices)
        )
        return up, down

    @abstractmethod
    def statistics(self) -> str:
        """tc's statistics as JSON."""

    @abstractmethod
    def stop(self) -> None:
        """End processes of its own; everything else goes with the namespaces."""


class Native(Backend):
    """netem of this kernel."""

    name = "native"

    @classmethod
    def missing(cls, probe: str) -> list[str]:
        lacking = missing_rights()
        if lacking:
            return lacking
        run(["ip", "netns", "add", probe])
        try:
            run(f"tc -n {probe} qdisc add dev lo root netem delay 1ms".split())
        except LabError:
            return ["netem in this kernel (module sch_netem: modprobe sch_netem)"]
        finally:
            run(["ip", "netns", "delete", probe])
        return []

    def cable(self) -> list[str]:
        ip = f"ip -n {self.middle}"
        return [
            f"{ip} link add to-right type veth peer name to-left",
            f"{ip} link set to-right master left up",
            f"{ip} link set to-left master right up",
        ]

    @property
    def devices(self) -> tuple[str, str]:
        return "to-right", "to-left"

    def start(self) -> Self:
        super().start()
        no_offloads(self.middle, self.devices)
        return self

    def tc(self, lines: Sequence[str]) -> str:
        return "".join(run(["tc", "-n", self.middle, *line.split()]) for line in lines)

    def statistics(self) -> str:
        return run(["tc", "-n", self.middle, "-s", "-j", "qdisc", "show"])

    def stop(self) -> None:
        return  # it has no processes


class InAppliance(Backend):
    """netem of a guest's kernel."""

    name = "appliance"

    def __init__(self, middle: str) -> None:
        super().__init__(middle)
        self._guest: Appliance | None = None

    @property
    def guest(self) -> Appliance:
        if self._guest is None:
            raise LabError("the lab has not been started")
        return self._guest

    @classmethod
    def missing(cls, probe: str) -> list[str]:
        del probe  # nothing has to be tried
        return [*missing_rights(), *appliance.missing()]

    def cable(self) -> list[str]:
        return [
            command
            for tap, side in zip(self._taps, SIDES, strict=True)
            for command in (
                f"ip -n {self.middle} tuntap add dev {tap} mode tap",
                f"ip -n {self.middle} link set {tap} txqueuelen {TAP_PACKETS} master {side} up",
            )
        ]

    @property
    def _taps(self) -> tuple[str, str]:
        return "tap0", "tap1"

    @property
    def devices(self) -> tuple[str, str]:
        return "eth1", "eth0"  # the guest's

    def start(self) -> Self:
        super().start()
        self._guest = Appliance(["ip", "netns", "exec", self.middle], self._taps)
        self._guest.wait_ready()
        return self

    def tc(self, lines: Sequence[str]) -> str:
        return self.guest.command(" && ".join(f"/sbin/tc {line}" for line in lines))

    def statistics(self) -> str:
        return self.guest.command("/sbin/tc -s -j qdisc show")

    def stop(self) -> None:
        if self._guest is not None:
            self._guest.stop()
            self._guest = None


BACKENDS: Final[dict[str, type[Backend]]] = {backend.name: backend for backend in (Native, InAppliance)}
"""The backends, in the order in which they are tried."""


def choose(lab: str, wanted: str | None = None) -> type[Backend]:
    """The first backend that works here, or the one that is wanted. LabError says what each is missing."""
    reasons = []
    for name, backend in BACKENDS.items():
        if wanted in (None, name):
            lacking = backend.missing(namespace_name(lab, "probe"))
            if not lacking:
                return backend
            reasons.append(f"{name} needs {', '.join(lacking)}")
    if not reasons:
        raise LabError(f"no backend {wanted!r}; there are: {', '.join(BACKENDS)}")
    check_rights()
    raise LabError(f"no lab here: {'; '.join(reasons)}")


def wiring(middle: str, endpoints: Sequence[Endpoint], congestion: str | None) -> list[str]:
    """The commands that join existing namespaces to the bridges; `congestion` is what their TCP uses."""
    ip = f"ip -n {middle}"
    commands = [f"{ip} link set lo up"]
    for side in SIDES:
        commands += [
            f"{ip} link add {side} type bridge forward_delay 0 stp_state 0 mcast_snooping 0",
            f"{ip} link set {side} up",
        ]
    for end in endpoints:
        inner = f"ip -n {end.namespace}"
        route = f"{inner} route replace {NETWORK}.0.0/{PREFIX} dev {DEVICE} proto kernel scope link src {end.address}"
        commands += [
            f"{ip} link add {end.port} type veth peer name {DEVICE} netns {end.namespace}",
            f"{inner} link set {DEVICE} address {end.hardware_address}",
            f"{ip} link set {end.port} master {SIDES[end.side]} up",
            f"{inner} link set lo up",
            f"{inner} address add {end.address}/{PREFIX} dev {DEVICE}",
            f"{inner} link set {DEVICE} up",
            f"{route} congctl {congestion}" if congestion else route,
        ]
        # Known neighbours: on a real path nobody asks for hardware addresses across the link, nor after a blackout.
        commands += [
            f"{inner} neighbour replace {other.address} lladdr {other.hardware_address} dev {DEVICE} nud permanent"
            for other in endpoints
            if other != end
        ]
    return commands


def build(middle: str, endpoints: Sequence[Endpoint], congestion: str | None, *, lock: int) -> None:
    """Make the namespaces and wire them, all but the link. LabError when something refuses.

    What makes a namespace holds the lab's lock: it may outlive this process, and who cleans up after that waits for it.
    """
    for namespace in (middle, *(end.namespace for end in endpoints)):
        run(["ip", "netns", "add", namespace], held=(lock,))
        quiet(namespace)
    run_all(wiring(middle, endpoints, congestion))
    no_offloads(middle, [end.port for end in endpoints])
    for end in endpoints:
        no_offloads(end.namespace, [DEVICE])


def endpoints_of(lab: str, sides: Sequence[Iterable[str]]) -> list[Endpoint]:
    """The namespaces of a lab, from the names of the nodes on side a and side b."""
    return [
        Endpoint(name, namespace_name(lab, name), side, number)
        for side, names in enumerate(sides)
        for number, name in enumerate(names, start=1)
    ]
