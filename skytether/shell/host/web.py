"""Rules for HTTP servers: the page and the metrics.

Any website can make a browser on this machine connect to these servers: in an invisible frame, or
by pointing its own domain at this machine (DNS rebinding). So answers must not be shown in frames,
and the Host header is checked.
"""

import ipaddress
from urllib.parse import urlsplit

HOST_PORT = "127.0.0.1:8080"
"""Default address of the page."""
HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
}
"""Headers of every answer, so that no website can show it in a frame and catch clicks."""


def host_name(host: str) -> str:
    """Host in a Host header, without its port; empty if there is none."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def numeric(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """IP address in a host name, with or without brackets and scope; None for other names."""
    try:
        return ipaddress.ip_address(name.strip("[]").partition("%")[0])
    except ValueError:
        return None


def is_ours(name: str) -> bool:
    """Whether a host is an IP address or localhost, which no website's owner can redirect."""
    return name == "localhost" or numeric(name) is not None
