"""Rules of what is served over HTTP, the page and the metrics.

Any website that a browser has open may make it connect to this machine, in an invisible frame or
under a name of the website's own that it points here (DNS rebinding). So no answer may be shown in
a frame, and the name under which a browser comes is looked at.
"""

import ipaddress
from urllib.parse import urlsplit

HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
}
"""Headers of every answer: no website may show it in a frame, and catch clicks in it."""


def host_name(host: str) -> str:
    """Name or number of this machine in a Host header, without its port; empty if there is none."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def numeric(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Address that a name is, if it is a number, in brackets or not, with a scope or not."""
    try:
        return ipaddress.ip_address(name.strip("[]").partition("%")[0])
    except ValueError:
        return None


def is_ours(name: str) -> bool:
    """Whether no stranger can point a name at this machine: a number, or localhost."""
    return name == "localhost" or numeric(name) is not None
