# Written from _async/connection.py by scripts/client.  Do not edit.
"""Requests to one service: sent, sent again where that may help, and their answers or errors."""

from __future__ import annotations

import re
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeVar

from placerec_client._http import httpx
from placerec_client._sync.concurrency import sleep
from placerec_client._sync.lanes import Lanes, check_address
from placerec_client.answers import UNKNOWN_OUTCOME, is_passing, parsed, refusal, retry_after
from placerec_client.errors import (
    ClientClosed,
    ConnectionFailed,
    DeadlineExceeded,
    InvalidParameter,
    PlacerecError,
    Problem,
    UnexpectedAnswer,
)
from placerec_client.model import Model
from placerec_client.problems import UnknownPath
from placerec_client.requests import dumps, query_string, seconds_of, text_of
from placerec_client.retry import Clock, Retry
from placerec_client.version import VERSION

Answer = TypeVar("Answer", bound=Model)
Content = bytes | Callable[[], Iterator[bytes]] | None
"""A body, or what makes it piece by piece for each attempt."""

CONNECT_SECONDS = 5.0
IDLE_SECONDS = 30.0
"""How long a connection stays open without a request; the service's limit is longer."""

SILENCE_SECONDS = 30.0
"""After how long a stream without a byte counts as lost; the service sends a comment every three seconds."""

LEAST_SECONDS, MOST_SECONDS = 0.001, 3600.0
"""Bounds of X-Request-Timeout."""

LONGEST_TIMEOUT = 86400.0
"""Seconds; a longer ``timeout``, such as infinity, is as good as this one."""

PAGE = 500
"""Items of one page of a listing, if the caller does not say."""

KNOWN_URLS = 1000

HOST = re.compile(r"(\[[0-9A-Fa-f:.%]+\]|[^\s:/?#@\[\]]+)(:[0-9]+)?(/[^\s?#]*)?")
"""The URL of a service without its scheme: a host, perhaps with a port and a path."""

KEY = re.compile(r"[!-~]+")
"""The visible characters of ASCII, of which a header may be made."""


class Connection:
    """The connection to a service, which all objects of one client share.

    Args:
        url: of the service; ``http://`` if it begins with a host.
        key: that is sent with every request; None for none.
        timeout: seconds to wait for one answer.
        retry: when a request is sent again.
        transport: of httpx, instead of the network.

    Raises:
        ConnectionFailed: the URL is none of a service.
        InvalidParameter: the key is no text, or has characters that none has, such as the end of the line after it in a
            file; ``timeout`` is no number, or not more than 0; ``retry`` is no ``Retry``.
    """

    def __init__(
        self,
        url: str,
        key: str | None,
        timeout: float,
        retry: Retry,
        transport: httpx.BaseTransport | None,
        name: str | None = None,
    ) -> None:
        self.url = service_url(url)
        self.name, self.timeout, self.retry = name or self.url, _timeout(timeout), _rule(retry)
        parsed_url = httpx.URL(self.url)
        self._closed = threading.Event()  # shared with the connections that differ in patience
        self._transport = transport or Lanes(parsed_url, IDLE_SECONDS)
        self.headers = [
            (b"Host", parsed_url.netloc),
            (b"User-Agent", f"placerec-client/{VERSION}".encode()),
        ]
        if key is not None:
            if not isinstance(key, str):
                raise InvalidParameter(f"The key has to be a text, not {type(key).__name__}.")
            if not KEY.fullmatch(key):  # httpx would show it in its error
                raise InvalidParameter("The key has characters that no key has, such as a space or the end of a line.")
            self.headers.append((b"Authorization", f"Bearer {key}".encode()))
        self._urls: dict[str, httpx.URL] = {}

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.state}>"

    @property
    def state(self) -> str:
        """The service and the state in words, without the key."""
        has_key = any(name == b"Authorization" for name, _ in self.headers)
        return self.name + ", with a key" * has_key + ", closed" * self._closed.is_set()

    def patient(self, retry: Retry) -> Connection:
        """The same connection with another rule of when a request is sent again.

        Raises:
            InvalidParameter: the rule is no ``Retry``.
        """
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__, retry=_rule(retry))
        return other

    def lasting(self, patience: float) -> Connection:
        """The same connection with this patience at least, if it has any."""
        retry = self.retry
        return self.patient(replace(retry, patience=max(patience, retry.patience))) if retry.patience else self

    def close(self) -> None:
        """Close all connections; later requests are refused."""
        self._closed.set()
        self._transport.close()

    def check_open(self) -> None:
        """Raise ClientClosed after ``close``."""
        if self._closed.is_set():
            raise ClientClosed

    def request(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        content: Content = None,
        json: Any = None,
        media_type: str | None = None,
        headers: Mapping[str, str] | None = None,
        deadline: float | None = None,
        request_id: str | None = None,
        final: frozenset[str] = frozenset(),
        accepted: tuple[int, ...] = (),
    ) -> httpx.Response:
        """Send a request and return its successful answer.

        Args:
            path: the path at the service, such as ``/v1/maps``.
            params: of the query string; those that are None are left out.
            content: the body, or what makes its pieces anew for each attempt.
            json: a body instead, as JSON.
            media_type: of the body.
            deadline: seconds from now after which an answer is of no use. The service gets it, and drops the request
                when it is over. None: only ``timeout`` and the patience of ``retry`` hold.
            request_id: of all attempts; made if left out.
            final: slugs of problems after which the request is not sent again.
            accepted: statuses besides 2xx that are returned, not raised.

        Raises:
            Problem: the service answers with a problem.
            ConnectionFailed, DeadlineExceeded, UnexpectedAnswer: no answer of a service came, or none in time.
            InvalidParameter: a value cannot be sent.
            ClientClosed: the connection was closed.
        """
        if json is not None:
            content, media_type = dumps(json).encode(), "application/json"
        sent = [*self.headers, (b"X-Request-Id", text_of("request_id", request_id or uuid.uuid4().hex).encode())]
        if media_type is not None:
            sent.append((b"Content-Type", media_type.encode()))
        if isinstance(content, bytes):
            sent.append((b"Content-Length", b"%d" % len(content)))
        elif content is None and method in ("POST", "PUT", "PATCH"):
            sent.append((b"Content-Length", b"0"))
        for name, value in (headers or {}).items():
            sent.append((name.encode(), value.encode()))
        url = self.url_of(path + query_string(params) if params else path)
        clock = Clock(deadline, self.retry)
        while True:
            outcome = self._attempt(method, url, sent, content, clock)
            if isinstance(outcome, httpx.Response):
                if outcome.is_success or outcome.status_code in accepted:
                    outcome.extensions["after_loss"] = clock.lost
                    return outcome
                failure: PlacerecError = self._refusal(outcome, clock.lost)
                if not is_passing(outcome) or (isinstance(failure, Problem) and failure.slug in final):
                    raise failure
                clock.lost = clock.lost or outcome.status_code in UNKNOWN_OUTCOME
                pause = clock.pause(retry_after(outcome))
            else:
                failure, pause = outcome, clock.pause()
            if pause is None:
                raise self._given_up(clock, failure)
            sleep(pause)

    def _attempt(
        self, method: str, url: httpx.URL, headers: list[tuple[bytes, bytes]], content: Content, clock: Clock
    ) -> httpx.Response | PlacerecError:
        """One attempt: its answer, or why there is none."""
        self.check_open()
        clock.attempts += 1
        left = clock.left()
        limit = self.timeout
        if left is not None:
            if left < LEAST_SECONDS:
                return DeadlineExceeded(f"{self.name} did not answer within {clock.deadline:g} s.")
            limit = min(limit, left)
            headers = [*headers, (b"X-Request-Timeout", f"{min(left, MOST_SECONDS):.3f}".encode())]
        times = {"connect": min(CONNECT_SECONDS, limit), "read": limit, "write": limit, "pool": limit}
        body = content() if callable(content) else content
        request = httpx.Request(method, url, headers=headers, content=body, extensions={"timeout": times})
        try:
            response = self._transport.handle_request(request)
            response.request = request
            if left is not None:
                assert isinstance(response.stream, httpx.SyncByteStream)
                response.stream = Timely(response.stream, clock, times)
            try:
                response.read()
            finally:
                response.close()
            return response
        except (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout) as error:
            return self._failure("cannot be reached", error)
        except httpx.TimeoutException as error:
            clock.lost = True
            return self._failure("did not answer in time", error)
        except httpx.HTTPError as error:
            clock.lost = True
            return self._failure("cannot be reached", error)

    def _failure(self, what: str, error: Exception) -> ConnectionFailed:
        reason = f": {error or type(error).__name__}" if what == "cannot be reached" else ""
        failure = ConnectionFailed(f"{self.name} {what}{reason}.")
        failure.__cause__ = error
        return failure

    def _refusal(self, response: httpx.Response, after_loss: bool = False) -> PlacerecError:
        """The error for an unsuccessful answer; where there is nothing at all, the URL may have a path too many."""
        failure = refusal(response, after_loss)
        is_lost = isinstance(failure, UnknownPath | UnexpectedAnswer) and response.status_code == 404
        if not is_lost or httpx.URL(self.url).path == "/":
            return failure
        right = self.url.removesuffix("/v1")
        hint = f"give {right}, without /v1" if right != self.url else "it is given without the path of an operation"
        return UnexpectedAnswer(
            f"{response.request.url} answered 404; {self.url} may not be the URL of a service: {hint}.", 404
        )

    def _given_up(self, clock: Clock, failure: PlacerecError) -> PlacerecError:
        """The error after the last attempt: that of the attempt, or that the deadline is over."""
        if clock.deadline is None or isinstance(failure, DeadlineExceeded):
            return failure
        exceeded = DeadlineExceeded(f"{self.name} did not answer within {clock.deadline:g} s: {failure}")
        exceeded.__cause__ = failure
        return exceeded

    def url_of(self, path: str) -> httpx.URL:
        """The URL of a path with its query string; parsing one takes time, so they are cached.

        Raises:
            InvalidParameter: the parameters are too long for one.
        """
        found = self._urls.get(path)
        if found is None:
            if len(self._urls) >= KNOWN_URLS:
                self._urls.clear()
            try:
                found = self._urls[path] = httpx.URL(self.url + path)
            except httpx.InvalidURL as error:
                raise InvalidParameter(f"The parameters make no URL: {error}.") from error
        return found

    def ask(self, model: type[Answer], method: str, path: str, **options: Any) -> Answer:
        """Send a request and return the model of its answer; it raises what ``request`` raises."""
        return parsed(model, (self.request(method, path, **options)).content)

    def pages(self, model: type[Answer], path: str, params: Mapping[str, Any]) -> Iterator[Answer]:
        """The pages of a listing in order; it raises what ``request`` raises."""
        cursor: str | None = None
        while True:
            page = self.ask(model, "GET", path, params={"limit": PAGE, **params, "cursor": cursor})
            yield page
            cursor = getattr(page, "next_cursor", None)
            if cursor is None:
                return

    @contextmanager
    def stream(self, path: str, headers: Mapping[str, str]) -> Iterator[httpx.Response]:
        """The answer to a GET whose body is read as it comes; it is sent once.

        Raises:
            Problem, ConnectionFailed, UnexpectedAnswer: it is no success, or none came.
            ClientClosed: the connection was closed.
        """
        self.check_open()
        sent = [*self.headers, *((name.encode(), value.encode()) for name, value in headers.items())]
        limit = min(self.timeout, SILENCE_SECONDS)
        times = {"connect": CONNECT_SECONDS, "read": limit, "write": limit, "pool": limit}
        request = httpx.Request("GET", self.url_of(path), headers=sent, extensions={"timeout": times})
        try:
            response = self._transport.handle_request(request)
            response.request = request
            try:
                if not response.is_success:
                    response.read()
                    raise self._refusal(response)
                yield response
            finally:
                response.close()
        except httpx.HTTPError as error:
            raise self._failure("cannot be reached", error) from error


def _timeout(timeout: object) -> float:
    """The seconds to wait for one answer, which a socket can count.

    Raises:
        InvalidParameter: it is no number, or not more than 0.
    """
    seconds = seconds_of("timeout", timeout)
    if seconds <= 0:
        raise InvalidParameter(f"timeout has to be more than 0 seconds, not {seconds:g}.")
    return min(seconds, LONGEST_TIMEOUT)


def _rule(retry: object) -> Retry:
    """Return the rule of when a request is sent again.

    Raises:
        InvalidParameter: it is none.
    """
    if not isinstance(retry, Retry):
        raise InvalidParameter(f"retry has to be a Retry, as in Retry(patience=5), not a {type(retry).__name__}.")
    return retry


def service_url(url: str) -> str:
    """The URL of a service in full, without a slash at its end; a host, with a port or without, is one by ``http``.

    Raises:
        ConnectionFailed: it is none.
    """
    if not isinstance(url, str):
        raise ConnectionFailed(f"{url!r} is not a URL of a service: it has to be a text.")
    full = url if url.startswith(("http://", "https://")) else f"http://{url}" if HOST.fullmatch(url) else None
    if full is None:
        raise ConnectionFailed(
            f"{url!r} is not a URL of a service: it has to start with http:// or https://, or with the service's host."
        )
    try:
        parsed_url = httpx.URL(full)
        if parsed_url.userinfo:  # perhaps a secret, which is not shown
            raise ConnectionFailed(
                "The URL of a service has no name and no password of a user; a key is given as key=."
            )
        check_address(parsed_url)
    except (httpx.InvalidURL, ValueError) as error:
        raise ConnectionFailed(f"{url!r} is not a URL: {error}.") from error
    if parsed_url.query or parsed_url.fragment:
        raise ConnectionFailed(f"{url!r} is not a URL of a service: it has a query string or a fragment.")
    return full.rstrip("/")


class Timely(httpx.SyncByteStream):
    """The body of an answer, which counts as lost when it is not complete at the deadline.

    The time limits of httpx are for one piece at a time; an answer in many pieces could last for any time.
    """

    def __init__(self, stream: httpx.SyncByteStream, clock: Clock, times: dict[str, float]) -> None:
        self._stream, self._clock, self._times = stream, clock, times

    def __iter__(self) -> Iterator[bytes]:
        limit = min(self._times["read"], self._left())
        self._times["read"] = max(limit, LEAST_SECONDS)  # httpx looks at it once, when the body begins
        for chunk in self._stream:
            yield chunk
            if self._left() <= 0:
                raise httpx.ReadTimeout("The deadline is over.")

    def _left(self) -> float:
        left = self._clock.left()
        return 0.0 if left is None else left

    def close(self) -> None:
        """Close the answer."""
        self._stream.close()
