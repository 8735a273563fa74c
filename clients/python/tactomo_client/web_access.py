"""Who a web server on this computer is spoken to by: what `Host` says of that.

A page elsewhere can have its name point here, and is then of one origin with whatever listens.
"""

from __future__ import annotations

import contextlib
import ipaddress
from urllib.parse import urlsplit


def is_loopback(host: str) -> bool:
    """Return whether only this computer can reach what listens on `host`."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def names_this_computer(host_header: str, served_host: str) -> bool:
    """Return whether a request was for an IP address, `localhost` or the name that is served."""
    try:
        name = urlsplit(f"//{host_header}").hostname or ""
    except ValueError:
        return False
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    return name in ("localhost", served_host.lower())
