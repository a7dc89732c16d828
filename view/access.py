"""Who may do more than look: a browser on this machine, or one that knows the token.

A browser takes pages from anywhere, and lets each of them connect to this machine. So it is not
enough that somebody connects from here: the page that does must be ours (`Origin`), under a name
that only this machine has (`Host`), or else a stranger's page could fly the vehicle.
"""

import hmac
import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit


@dataclass(frozen=True, slots=True)
class Visitor:
    """How a browser has connected."""

    host: str
    """Host that it connects from."""
    path: str
    """Path and query that it asked for."""
    headers: Mapping[str, str]
    """Headers of its request; names in any case."""


def is_loopback(host: str) -> bool:
    """Whether a host is this machine, under a name or address that no other machine has."""
    if host == "localhost":
        return True
    try:
        address = ipaddress.ip_address(host.strip("[]").partition("%")[0])
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return bool((mapped or address).is_loopback)


def knows(token: str, given: str) -> bool:
    """Whether somebody has given the token; never where there is none."""
    return bool(token) and hmac.compare_digest(token.encode(), given.encode())


def may_play(visitor: Visitor, token: str) -> bool:
    """Whether a browser may change what flies."""
    given = parse_qs(urlsplit(visitor.path).query).get("token", [""])[0]
    if knows(token, given):
        return True
    if not is_loopback(visitor.host):
        return False
    headers = {name.lower(): value for name, value in visitor.headers.items()}
    host, origin = headers.get("host", ""), headers.get("origin", "")
    try:
        here = is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False
    return here and origin in ("", f"http://{host}")
