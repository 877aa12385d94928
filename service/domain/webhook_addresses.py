"""Addresses that webhooks may lead to: those of the internet, over https, unless the operator allows others."""

from __future__ import annotations

import ipaddress
import socket
from urllib.parse import urlsplit

from service.errors import AddressRefused

Address = ipaddress.IPv4Address | ipaddress.IPv6Address

# IANA's registries of special-purpose addresses. Python's `is_global` has them as they were when it was released.
_NOT_PUBLIC_V4 = tuple(
    map(
        ipaddress.IPv4Network,
        (
            "0.0.0.0/8", "10.0.0.0/8", "100.64.0.0/10", "127.0.0.0/8", "169.254.0.0/16", "172.16.0.0/12",
            "192.0.0.0/24", "192.0.2.0/24", "192.88.99.0/24", "192.168.0.0/16", "198.18.0.0/15", "198.51.100.0/24",
            "203.0.113.0/24", "224.0.0.0/4", "240.0.0.0/4",
        ),
    )
)  # fmt: skip
# What is not global unicast is refused as a whole: loopback, site-local, multicast, and IPv4 in other clothes.
_UNICAST_V6 = ipaddress.IPv6Network("2000::/3")
# Protocol assignments with Teredo and ORCHID, documentation, 6to4.
_NOT_PUBLIC_V6 = tuple(map(ipaddress.IPv6Network, ("2001::/23", "2001:db8::/32", "2002::/16", "3fff::/20")))
_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")


def require_url(url: str, *, allow_private: bool) -> None:
    """Refuse an address that is never told anything; the addresses of its name are checked at every try.

    Parameters
    ----------
    allow_private
        Whether it may be unencrypted, or lead to a private network.

    Raises
    ------
    AddressRefused
    """
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname or "", parts.port
    except ValueError as error:
        raise AddressRefused(f"url {url!r} is not one: {error}", remedy="Correct it.") from None
    if not host or "@" in parts.netloc or "\\" in parts.netloc or parts.fragment:
        raise AddressRefused(
            "the url has no host, or has a user, a password or a fragment", remedy="Give scheme, host and path alone."
        )
    if allow_private:
        return
    if parts.scheme != "https":
        raise AddressRefused("the url is not encrypted", remedy="Give an https url.")
    literal, name = _address_of(host), host.rstrip(".")
    if name == "localhost" or name.endswith(".localhost") or (literal is not None and not _is_public(literal)):
        raise AddressRefused(
            f"{host} is an address of a private network", remedy="Give an address that is reached from the internet."
        )


def is_public(address: str) -> bool:
    """Return whether an address is one of the internet, also where one of IPv4 is written as one of IPv6."""
    found = _address_of(address)
    return found is not None and _is_public(found)


def _is_public(address: Address) -> bool:
    if isinstance(address, ipaddress.IPv4Address):
        return not any(address in network for network in _NOT_PUBLIC_V4)
    if address.ipv4_mapped is not None:
        return _is_public(address.ipv4_mapped)
    if address in _NAT64:
        return _is_public(ipaddress.IPv4Address(int(address) & 0xFFFFFFFF))
    return address in _UNICAST_V6 and not any(address in network for network in _NOT_PUBLIC_V6)


def _address_of(host: str) -> Address | None:
    """The address that a host is; None for a name."""
    try:
        return ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        pass
    try:
        return ipaddress.IPv4Address(socket.inet_aton(host))  # as resolvers read 127.1, 0x7f000001 and 2130706433
    except (OSError, UnicodeError):
        return None
