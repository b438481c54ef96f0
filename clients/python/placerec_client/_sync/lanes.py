# Written from _async/lanes.py by scripts/client.  Do not edit.
"""Connections to the service, one for each request that is under way at a time.

httpx's pool looks at all of its connections whenever a request begins or ends; with many requests at a time that takes
longer than the requests themselves.  Here every request has a transport of its own, which has one connection, and is
lent to the next request afterwards.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from urllib.request import getproxies, proxy_bypass

from placerec_client._http import httpx
from placerec_client._sync.concurrency import interruptible
from placerec_client.errors import ConnectionFailed

HOST_NAME = re.compile(r"([A-Za-z0-9_-]{1,63}\.)*[A-Za-z0-9_-]{1,63}\.?")
"""The name of a host, or its IPv4 address, as they are sent; those of other alphabets are written in this one."""


class Lanes(httpx.BaseTransport):
    """A transport of httpx to one service.

    Args:
        url: of the service.
        idle: seconds for which a connection stays open without a request.
    """

    def __init__(self, url: httpx.URL, idle: float) -> None:
        self._limits = httpx.Limits(max_connections=1, max_keepalive_connections=1, keepalive_expiry=idle)
        self._verify = httpx.create_ssl_context() if url.scheme == "https" else False
        self._proxy = _proxy(url)
        self._free: list[httpx.HTTPTransport] = []
        self._all: list[httpx.HTTPTransport] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request; its transport is free again when the answer is closed."""
        lane = self._lane()
        try:
            response = lane.handle_request(request)
        except BaseException:
            self._free.append(lane)  # its connection is closed
            raise
        assert isinstance(response.stream, httpx.SyncByteStream)
        response.stream = Lent(response.stream, self._free, lane)
        return response

    def _lane(self) -> httpx.HTTPTransport:
        try:
            return self._free.pop()
        except IndexError:
            made = interruptible(httpx.HTTPTransport(verify=self._verify, limits=self._limits, proxy=self._proxy))
            self._all.append(made)
            return made

    def close(self) -> None:
        """Close all connections."""
        for lane in self._all:
            lane.close()


class Lent(httpx.SyncByteStream):
    """The body of an answer, whose transport is given back when it is closed."""

    def __init__(
        self, stream: httpx.SyncByteStream, free: list[httpx.HTTPTransport], lane: httpx.HTTPTransport
    ) -> None:
        self._stream, self._free, self._lane = stream, free, lane
        self._open = True

    def __iter__(self) -> Iterator[bytes]:
        for chunk in self._stream:
            yield chunk

    def close(self) -> None:
        """Close the answer."""
        if self._open:
            self._open = False
            try:
                self._stream.close()
            finally:
                self._free.append(self._lane)


def check_address(url: httpx.URL) -> None:
    """Raise ValueError, which says why, if nothing is at the host and the port of a URL."""
    if url.port is not None and not 1 <= url.port <= 65535:  # a socket would take it modulo 65536
        raise ValueError(f"its port {url.port} is not one from 1 to 65535")
    host = url.raw_host.decode()
    if ":" not in host and not HOST_NAME.fullmatch(host):  # httpx has checked IPv6
        raise ValueError(f"its host {url.host!r} is no name of one" if host else "it names no host")


def _proxy(url: httpx.URL) -> httpx.Proxy | None:
    """The proxy that the environment names for a service, by the rules of httpx; None for none.

    Raises:
        ConnectionFailed: the environment names no usable proxy.
    """
    named = getproxies()
    found = named.get(url.scheme) or named.get("all")
    if not found or proxy_bypass(url.host):
        return None
    try:
        proxy = httpx.Proxy(found if "://" in found else f"http://{found}")
        check_address(proxy.url)
        return proxy
    except (ValueError, httpx.InvalidURL) as error:
        raise ConnectionFailed(f"The environment names a proxy that is none: {error}.") from error
