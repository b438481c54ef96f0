"""Web pages as callers, where there are no keys: a browser on this machine would send what any page asks it to.

A page of elsewhere cannot read the answers, but a write needs none.  Browsers say where a request comes from; other
clients send no such header and are not concerned.  A page can also have its own name lead to 127.0.0.1 (DNS
rebinding), and then it is no page of elsewhere; but its requests are addressed to that name.
"""

from __future__ import annotations

import ipaddress
from functools import lru_cache
from urllib.parse import urlsplit

from service.errors.faults import ForeignPage

Headers = list[tuple[bytes, bytes]]

OWN_SITES = frozenset({b"same-origin", b"none"})
"""``Sec-Fetch-Site`` of a page of ours, and of an address that somebody typed."""


def check_page(headers: Headers) -> None:
    """Refuse what a page of another origin sends.

    Raises:
        ForeignPage: the browser says that it does.
    """
    host = origin = site = None
    for name, value in headers:
        if name == b"origin":
            origin = value
        elif name == b"sec-fetch-site":
            site = value
        elif name == b"host":
            host = value
    if site is not None and site not in OWN_SITES:
        raise ForeignPage("A page of another site sends this; without keys that is refused.")
    if origin is not None and _host_of(origin) != (host or b"").lower():
        raise ForeignPage("A page of another origin sends this; without keys that is refused.")


def _host_of(origin: bytes) -> bytes | None:
    """The host that an Origin header names, with its port; None where it is no origin."""
    try:
        return urlsplit(origin.decode("latin-1")).netloc.lower().encode("latin-1")
    except ValueError:
        return None


def check_host(headers: Headers) -> None:
    """Refuse what is addressed to another name than this machine's own.

    Raises:
        ForeignPage: the Host header names another host, or there are two.
    """
    named = [value for name, value in headers if name == b"host"]
    if len(named) > 1 or (named and not is_loopback_host(named[0])):
        raise ForeignPage(
            "Without keys the service answers to localhost and 127.0.0.1 only, not to other names; create a key."
        )


@lru_cache(64)
def is_loopback_host(host: bytes) -> bool:
    """Whether a Host header names this machine to itself."""
    try:
        name = urlsplit(f"//{host.decode('ascii')}").hostname or ""
    except ValueError:
        return False
    if name == "localhost" or name.endswith(".localhost"):
        return True
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False
