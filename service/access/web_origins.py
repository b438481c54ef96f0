"""Protection against web pages while there are no keys: a browser on this machine sends what any page asks it to send.

A page of another site cannot read the answers, but it needs none to write.  Browsers say which page sends a request;
other clients send no such header and are not affected.  A page can also point its own host name to 127.0.0.1 (DNS
rebinding), so that its requests come from the same origin; but then they are addressed to that host name.
"""

from __future__ import annotations

import ipaddress
from functools import lru_cache
from urllib.parse import urlsplit

from service.errors.faults import ForeignPage

Headers = list[tuple[bytes, bytes]]

OWN_SITES = frozenset({b"same-origin", b"none"})
"""Values of ``Sec-Fetch-Site``: a page of this service, and an address that a person typed."""


def check_page(headers: Headers) -> None:
    """Refuse requests from pages of other origins.

    Raises:
        ForeignPage: the headers say that the request comes from such a page.
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
        raise ForeignPage(
            "The request comes from a web page of another site, which is refused while the service has no keys."
        )
    if origin is not None and _host_of(origin) != (host or b"").lower():
        raise ForeignPage(
            "The request comes from a web page of another origin, which is refused while the service has no keys."
        )


def _host_of(origin: bytes) -> bytes | None:
    """The host and port of an Origin header; None if it is not an origin."""
    try:
        return urlsplit(origin.decode("latin-1")).netloc.lower().encode("latin-1")
    except ValueError:
        return None


def check_host(headers: Headers) -> None:
    """Refuse requests that are addressed to another host name than this machine's own.

    Raises:
        ForeignPage: the Host header names another host, or there are two.
    """
    named = [value for name, value in headers if name == b"host"]
    if len(named) > 1 or (named and not is_loopback_host(named[0])):
        raise ForeignPage(
            "While the service has no keys, it answers only requests to localhost or 127.0.0.1. "
            "Create a key to use it under another name."
        )


@lru_cache(64)
def is_loopback_host(host: bytes) -> bool:
    """Whether a Host header is a loopback name or address."""
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
