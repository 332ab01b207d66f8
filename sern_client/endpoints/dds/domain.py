"""DDS domains of this process. Cyclone DDS has each domain once a process, with one configuration."""

import os
from dataclasses import dataclass
from typing import Final
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain

from sern_core.vocabulary.errors import ConfigError

MAX_DOMAIN: Final = 232
LOOPBACK_FRAGMENT_BYTES: Final = 62_000
"""Larger datagrams than a network takes whole: on loopback every datagram costs a system call, and none is lost."""
HEARTBEAT_MS: Final = 10
"""How soon a writer asks whether all has come, where the last of a large message may be lost. A cloud of 1 MB runs over
the socket buffer that Fast DDS has by default; with the 100 ms of Cyclone DDS that took 122 ms, so it takes 20 to 34
(measured)."""
FAST_DDS_VENDOR: Final = "1.15"
"""The vendor id of eProsima (RTPS 2.5, 9.3.1.2), as Cyclone DDS's configuration has it."""
PARTICIPANTS_A_HOST: Final = 32
"""How many participants are looked for on each host that multicast does not reach."""


@dataclass(frozen=True, slots=True)
class DomainOptions:
    """How participants find and reach each other. None and empty: as Cyclone DDS, or `CYCLONEDDS_URI`, has it."""

    domain: int = 0
    interface: str | None = None
    peers: tuple[str, ...] = ()
    multicast: bool | None = None
    localhost_only: bool = False
    fragment_bytes: int | None = None
    receive_buffer_bytes: int | None = None
    lease_s: float | None = None

    def to_xml(self) -> str:
        """The configuration fragment that says so."""
        interface = "lo" if self.localhost_only else self.interface
        peers = self.peers or (("127.0.0.1",) if self.localhost_only else ())
        multicast = False if self.localhost_only else self.multicast
        fragment = self.fragment_bytes or (LOOPBACK_FRAGMENT_BYTES if self.localhost_only else None)
        general, discovery, internal = "", "", ""
        # Fast DDS does not notice that a reader, writer or participant went when the key hash is not sent.
        internal += "<GenerateKeyhash>true</GenerateKeyhash>"
        internal += f'<HeartbeatInterval min="5ms" minsched="5ms" max="8s">{HEARTBEAT_MS}ms</HeartbeatInterval>'
        if interface:
            key = "address" if interface[0].isdigit() or ":" in interface else "name"
            extra = ' multicast="false"' if multicast is False else ""
            general += f"<Interfaces><NetworkInterface {key}={quoteattr(interface)}{extra}/></Interfaces>"
        if multicast is not None:
            general += f"<AllowMulticast>{str(multicast).lower()}</AllowMulticast>"
        if fragment:
            general += f"<FragmentSize>{fragment}B</FragmentSize>"
        if multicast is False or peers:
            discovery += "<ParticipantIndex>auto</ParticipantIndex>"
            discovery += f"<MaxAutoParticipantIndex>{PARTICIPANTS_A_HOST - 1}</MaxAutoParticipantIndex>"
        if peers:
            addresses = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in peers)
            discovery += f"<Peers>{addresses}</Peers>"
        if self.lease_s is not None:
            discovery += f"<LeaseDuration>{round(self.lease_s * 1000)}ms</LeaseDuration>"
        if self.receive_buffer_bytes or self.localhost_only:
            internal += f'<SocketReceiveBufferSize max="{self.receive_buffer_bytes or 4 * 2**20}B"/>'
        # Type objects of Fast DDS 3 (Kilted) are none to Cyclone DDS, which would match half of all types with nothing.
        compatibility = f"<IgnoreTypeInformation>{FAST_DDS_VENDOR}</IgnoreTypeInformation>"
        parts = (
            ("General", general), ("Discovery", discovery), ("Internal", internal), ("Compatibility", compatibility),
        )  # fmt: skip
        text = "".join(f"<{name}>{content}</{name}>" for name, content in parts if content)
        return f'<Domain id="any">{text}</Domain>'


def environment_domain() -> int:
    """`ROS_DOMAIN_ID`, or 0 where it is not set. ConfigError when it is no domain."""
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isdecimal() or int(text) > MAX_DOMAIN:
        raise ConfigError(f"ROS_DOMAIN_ID={text} is not a number from 0 to {MAX_DOMAIN}")
    return int(text)


@dataclass(slots=True)
class _Open:
    domain: Domain
    options: DomainOptions
    users: int


_open: Final[dict[int, _Open]] = {}


def open_domain(options: DomainOptions) -> None:
    """Make sure the domain exists; to be closed once for each time it is opened.

    ConfigError when this process has it with other settings, or Cyclone DDS refuses the settings.
    """
    known = _open.get(options.domain)
    if known is not None:
        if known.options != options:
            raise ConfigError(f"DDS domain {options.domain} is used twice with different settings; make them equal")
        known.users += 1
        return
    parts = (os.environ.get("CYCLONEDDS_URI", ""), options.to_xml())
    try:
        domain = Domain(options.domain, ",".join(part for part in parts if part) or None)
    except DDSException as error:
        raise ConfigError(
            f"DDS domain {options.domain} cannot be opened: Cyclone DDS does not accept its settings or "
            f"CYCLONEDDS_URI (it wrote why on standard error): {error.msg}"
        ) from None
    _open[options.domain] = _Open(domain, options, 1)


def close_domain(domain_id: int) -> None:
    known = _open[domain_id]
    known.users -= 1
    if not known.users:
        del _open[domain_id]
        # The binding deletes what is collected; nobody else has this one.
        known.domain.__del__()
