"""Access rules of a page: which visitors may watch, and which may change the flight.

Any website in the user's browser can make the browser connect to this machine. So a connection from
this machine is not sufficient: the request must come from our page (`Origin`), loaded under a name
that nobody else can point at this machine (`Host`). Otherwise any website could read the flight, or
change it. A visitor with the token needs no checks.
"""

import hmac
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from urllib.parse import parse_qs, urlsplit

from skytether.shell.host.web import host_name, is_ours, numeric


class TurnedAway(Enum):
    """Reason for refusing a browser, or for dropping its message."""

    ORIGIN = "a website of another origin tried to connect"
    HOST = "a browser used a name as address; expected a number, localhost, or the token"
    VERSION = "a browser has a page of another version open"
    FULL = "there are too many browsers"
    IDLE = "a connection that has sent nothing made room for another"
    MESSAGE = "a browser has sent a message that the page does not accept"
    ROOM = "a browser has sent more than the page can queue"
    PANEL = "a browser has sent an invalid value"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True, slots=True)
class Visitor:
    """Fields of a browser's request on which its access depends."""

    host: str
    path: str
    headers: Mapping[str, str]
    """Headers of the request; names in any case."""


def is_loopback(host: str) -> bool:
    """Whether a name or address always refers to this machine."""
    if host == "localhost":
        return True
    address = numeric(host)
    mapped = getattr(address, "ipv4_mapped", None)
    return bool(address and (mapped or address).is_loopback)


def knows(token: str, given: str) -> bool:
    """Whether a visitor's token is right; False if the page has no token."""
    return bool(token) and hmac.compare_digest(token.encode(), given.encode())


def _has_token(visitor: Visitor, token: str) -> bool:
    return knows(token, parse_qs(urlsplit(visitor.path).query).get("token", [""])[0])


def _named(visitor: Visitor) -> tuple[str, str, str]:
    headers = {name.lower(): value for name, value in visitor.headers.items()}
    host = headers.get("host", "")
    return host_name(host), host, headers.get("origin", "")


def refusal(visitor: Visitor, token: str) -> TurnedAway | None:
    """Reason why a browser may not watch; None if it may.

    A numeric address is accepted, because it cannot be rebound to this machine as a name can.
    """
    name, host, origin = _named(visitor)
    if _has_token(visitor, token):
        return None
    if not is_ours(name):
        return TurnedAway.HOST
    return None if origin in ("", f"http://{host}") else TurnedAway.ORIGIN


def may_play(visitor: Visitor, token: str) -> bool:
    if _has_token(visitor, token):
        return True
    is_here = is_loopback(visitor.host) and is_loopback(_named(visitor)[0])
    return is_here and refusal(visitor, token) is None
