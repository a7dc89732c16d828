"""Who may look at a page, and who may change what flies.

A browser takes websites from anywhere, and lets each of them connect to this machine. So it is not
enough that somebody connects from here: the website that does must be ours (`Origin`), under a
name that no stranger can let mean this machine (`Host`), or else a stranger's website could read
the flight, or fly it. Who gives the token is asked neither.
"""

import hmac
import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from urllib.parse import parse_qs, urlsplit

HOST_PORT = "127.0.0.1:8080"
"""Address of a page unless another is given."""


class TurnedAway(Enum):
    """Why a browser is turned away, or what it has sent is dropped."""

    ORIGIN = "a website of another origin wanted to connect"
    HOST = "a browser came by a name; number, localhost or the address with the token is expected"
    VERSION = "a browser has a page of another version open"
    FULL = "there are too many browsers"
    MESSAGE = "a browser has sent what the page does not take"
    ROOM = "a browser has sent more than there is room for"
    PANEL = "what a browser has sent makes no sense"

    def __str__(self) -> str:
        return self.value


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
    address = _number(host)
    mapped = getattr(address, "ipv4_mapped", None)
    return bool(address and (mapped or address).is_loopback)


def _number(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.strip("[]").partition("%")[0])
    except ValueError:
        return None


def knows(token: str, given: str) -> bool:
    """Whether somebody has given the token; never where there is none."""
    return bool(token) and hmac.compare_digest(token.encode(), given.encode())


def _has_token(visitor: Visitor, token: str) -> bool:
    return knows(token, parse_qs(urlsplit(visitor.path).query).get("token", [""])[0])


def _named(visitor: Visitor) -> tuple[str, str, str]:
    """Host that a browser takes this machine for, that with its port, and its website's origin."""
    headers = {name.lower(): value for name, value in visitor.headers.items()}
    host = headers.get("host", "")
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        name = ""
    return name, host, headers.get("origin", "")


def refusal(visitor: Visitor, token: str) -> TurnedAway | None:
    """Why a browser may not even look; None where it may.

    A number cannot be rebound as a name can, whoever's it is.
    """
    name, host, origin = _named(visitor)
    if _has_token(visitor, token):
        return None
    if name != "localhost" and _number(name) is None:
        return TurnedAway.HOST
    return None if origin in ("", f"http://{host}") else TurnedAway.ORIGIN


def may_play(visitor: Visitor, token: str) -> bool:
    """Whether a browser may change what flies."""
    if _has_token(visitor, token):
        return True
    here = is_loopback(visitor.host) and is_loopback(_named(visitor)[0])
    return here and refusal(visitor, token) is None
