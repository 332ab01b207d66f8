"""Addresses of peers as people, logs and limits know them."""

from typing import Final

_MAPPED: Final = "::ffff:"


def plain_host(host: str) -> str:
    """`host` as the kernel writes it, except that IPv4 is IPv4 also where a socket of both families took it: it has
    `::ffff:192.0.2.1` there (RFC 4291, 2.5.5.2)."""
    return host.removeprefix(_MAPPED) if "." in host else host
