"""Connections of the asynchronous half, whose look-ups of names are not waited for when they are broken off.

asyncio looks names up in threads that the end of its loop and of the process waits for, however long no name server
answers.
"""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterable
from concurrent.futures import Future
from ipaddress import ip_address
from typing import Any

import httpcore


class Backend(httpcore.AnyIOBackend):
    """The network of httpcore, but for the look-ups: each has a thread that keeps nothing from ending."""

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.AsyncNetworkStream:
        """Connect to the first address of a host that lets one; each has an equal share of the time that is left.

        Raises:
            httpcore.ConnectError: the host has no address, or none lets one connect.
            httpcore.ConnectTimeout: there was not enough time.
        """
        began = time.monotonic()
        addresses = await _addresses(host, port, timeout)
        while True:
            address = addresses.pop(0)
            left = None if timeout is None else (timeout - (time.monotonic() - began)) / (len(addresses) + 1)
            try:
                return await super().connect_tcp(address, port, left, local_address, socket_options)
            except (httpcore.ConnectError, httpcore.ConnectTimeout):
                if not addresses:
                    raise


async def _addresses(host: str, port: int, timeout: float | None) -> list[str]:
    """The addresses of a host, one or more, in the order in which they are to be tried; an address has itself."""
    try:
        return [str(ip_address(host))]
    except ValueError:
        pass
    found: Future[list[Any]] = Future()
    found.set_running_or_notify_cancel()  # who waits may be cancelled, the look-up is not

    def look_up() -> None:
        try:
            found.set_result(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM))
        except BaseException as error:
            found.set_exception(error)

    threading.Thread(target=look_up, daemon=True, name="placerec").start()
    try:
        async with asyncio.timeout(timeout):
            return [address[0] for *_, address in await asyncio.wrap_future(found)]
    except TimeoutError as error:
        raise httpcore.ConnectTimeout(f"The name {host} was not looked up in time.") from error
    except OSError as error:
        raise httpcore.ConnectError(str(error)) from error
