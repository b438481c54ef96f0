"""One HTTP connection: uvicorn's protocol, with limits on all that a client chooses and on the time of each step."""

from __future__ import annotations

import asyncio
import http
import logging
import re
import secrets
import sys
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from service.errors.faults import (
    Fault,
    HeadTooLarge,
    HeadTooSlow,
    MalformedHead,
    TooManyConnections,
    UnknownTransferCoding,
    UrlTooLong,
)
from service.errors.problems import MEDIA_TYPE, RETRY_LATER, declared, problem_of, retry_after
from service.http.connections import LEAST_PROGRESS, Connections, untaken
from service.http.websocket_connection import WebSocketConnection, handshake_fault

LINGER_SECONDS = 2.0
"""How long further bytes of a refused client are read and discarded: if the connection were closed at once, the client
might lose the answer."""

LAST_SECONDS = 0.25
"""How long an idle connection stays open when the service stops, for a request that is already on its way."""

FIELD_EXTRA = 4
"""Bytes of a header line besides its name and value: the colon, the space, the end of the line."""

HOST = re.compile(rb"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._~!$&'()*+,;=%-]*)(:[0-9]*)?")
"""A Host header: an IPv6 address in brackets, or any other host, and a port."""

log = logging.getLogger("placerec.connections")


class _Refused(Exception):
    """Raised in the parser's callbacks to stop it: nothing that follows is read."""


class HttpConnection(HttpToolsProtocol):
    """A connection that is closed when its client is too slow, sends too much, or is one too many.

    Args:
        connections: the register of all connections, with the limits.
        more: uvicorn's own arguments of a protocol.
    """

    def __init__(self, *, connections: Connections, **more: Any) -> None:
        super().__init__(**more)
        self._connections, self._settings = connections, connections.settings
        self.logger = logging.getLogger("uvicorn.http")  # refusals are logged below
        self._refusal: Fault | None = None
        self._stopped_reading = False
        self._last = False  # the connection is closed after the next answer
        self._surplus = False
        self._in_head = self._in_message = False
        self._began = False  # a head began in the bytes that came last
        self._url_size = self._fields_size = self._fields = self._partial = 0
        self._head_timer: asyncio.TimerHandle | None = None
        self._write_timer: asyncio.TimerHandle | None = None
        self._end_timer: asyncio.TimerHandle | None = None
        self._unwritten = 0

    # The connection's beginning and end

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        refused = self._connections.admit(self, self.client[0] if self.client else "")
        seconds = self._settings.head_timeout
        if refused == "flood":
            self._connections.ended("flood")
            transport.abort()
            return
        if refused is not None:
            self._surplus, seconds = True, min(LINGER_SECONDS, seconds)
        self._head_timer = self.loop.call_later(seconds, self._head_too_slow)

    def connection_lost(self, exc: Exception | None) -> None:
        self._connections.leave(self)
        for timer in (self._head_timer, self._write_timer, self._end_timer):
            if timer is not None:
                timer.cancel()
        self._unset_keepalive_if_required()
        super().connection_lost(exc)

    def give_way(self) -> None:
        """Close to make room for another connection."""
        self._end("made-room")

    def shutdown(self) -> None:
        """Answer the request that is under way or just arriving, then close."""
        self._last = True
        if self._is_working():
            super().shutdown()
        elif self._end_timer is None:
            self._end_timer = self.loop.call_later(LAST_SECONDS, self._end, "stopping")

    def timeout_keep_alive_handler(self) -> None:
        """Close a connection that was idle for too long, unless the client is still reading the last answer."""
        if untaken(self.transport):
            self._await_request()
        else:
            self._end("idle")

    def _is_working(self) -> bool:
        """Whether a request waits for its answer."""
        return self.cycle is not None and not self.cycle.response_complete

    def _end(self, reason: str) -> None:
        if self.transport is None or self.transport.is_closing():
            return
        self._connections.ended(reason)
        self._close()

    def _close(self) -> None:
        """Close once the client has read the written bytes, which is timed as any answer is."""
        self.transport.close()
        self._watch_rest()

    # Incoming

    def data_received(self, data: bytes) -> None:
        if self._stopped_reading:
            return
        self._began = False
        super().data_received(data)
        if self._stopped_reading or self.transport.is_closing() or self.transport.get_protocol() is not self:
            return
        if self._in_head and not self._began:
            # Only chunks that lie wholly within the head are counted: others may begin with the end of a body.
            self._partial += len(data)
            if self._partial > self._settings.max_url_bytes + self._settings.max_header_bytes:
                self._refusal = HeadTooLarge("The head of the request does not end within the limit.")
                self.send_400_response("")
                return
        timed = self._in_message or self._is_working() or self.flow.write_paused or self.timeout_keep_alive_task
        if self._head_timer is None and (self._in_head or not timed):
            self._head_timer = self.loop.call_later(self._settings.head_timeout, self._head_too_slow)

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._unset_keepalive_if_required()
        self._in_head = self._in_message = self._began = True
        self._url_size = self._fields_size = self._fields = self._partial = 0

    def on_url(self, url: bytes) -> None:
        self._url_size += len(url)
        if self._url_size > self._settings.max_url_bytes:
            most = self._settings.max_url_bytes
            self._refuse(UrlTooLong(f"The path and the query string have more than {most} bytes."))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        settings = self._settings
        self._fields += 1
        self._fields_size += len(name) + len(value) + FIELD_EXTRA
        if self._fields > settings.max_headers:
            self._refuse(HeadTooLarge(f"The request has more than {settings.max_headers} headers."))
        if self._fields_size > settings.max_header_bytes:
            self._refuse(HeadTooLarge(f"The headers have more than {settings.max_header_bytes} bytes."))
        if self._in_head:  # the trailers of a body are ignored
            if name.lower() == b"transfer-encoding":
                self._check_codings(value)
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        self._in_head = False
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None
        if self._end_timer is not None:
            self._end_timer.cancel()
            self._end_timer = None
        if self._surplus:
            self._refuse(TooManyConnections("Too many connections are open. Try again in a moment."))
        ahead = len(self.pipeline) + 1 if self._is_working() else 0
        if ahead >= self._settings.max_pipelined or (ahead and self.parser.should_upgrade()):
            self._connections.ended("pipelining")
            self._stop_listening()
            raise _Refused
        self._check_host()
        if self.parser.should_upgrade() and self._should_upgrade():
            self._check_handshake()
        super().on_headers_complete()
        if self._is_working():
            self._connections.work(self)
            if self._last or self._connections.draining:
                self.cycle.keep_alive = False

    def on_message_complete(self) -> None:
        self._in_message = False
        super().on_message_complete()
        if self._head_timer is not None:  # it timed the rest of a refused body, which is here now
            self._head_timer.cancel()
            self._head_timer = None
            self._await_request()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.transport.is_closing():
            self._watch_rest()
        elif not self._is_working() and not self.pipeline:
            self._unset_keepalive_if_required()
            self._watch_rest()
            if not self.flow.write_paused:
                self._await_request()

    def _await_request(self) -> None:
        """Wait for the client: every request is answered, and the client has read the answers."""
        self._connections.wait(self)
        if not self._in_message:
            seconds, idle = self.timeout_keep_alive, self.timeout_keep_alive_handler
            self.timeout_keep_alive_task = self.loop.call_later(seconds, idle)
        elif self._head_timer is None:
            # The rest of a refused body is discarded, but not for ever.
            self._head_timer = self.loop.call_later(self._settings.read_timeout, self._head_too_slow)

    def _check_codings(self, codings: bytes) -> None:
        if unknown := {coding.strip().lower() for coding in codings.split(b",")} - {b"chunked"}:
            named = ", ".join(sorted(repr(one[:40].decode("latin-1")) for one in unknown))
            self._refuse(UnknownTransferCoding(f"The transfer coding {named} is not known; send chunked, or none."))

    def _check_host(self) -> None:
        """Refuse a request that says of no host, of two, or of an impossible one that it is meant for it (RFC 9112)."""
        hosts = [value for name, value in self.headers if name == b"host"]
        if len(hosts) > 1:
            self._refuse(MalformedHead("The request has more than one Host header."))
        if not hosts and self.parser.get_http_version() != "1.0":
            self._refuse(MalformedHead("The request has no Host header."))
        if hosts and not HOST.fullmatch(hosts[0].strip()):
            self._refuse(MalformedHead("The Host header is not a host and a port."))

    def _check_handshake(self) -> None:
        start = b"%b %b HTTP/%b" % (self.parser.get_method(), self.url, self.parser.get_http_version().encode())
        fields = [name + b": " + value for name, value in self.headers]
        fault = handshake_fault(b"\r\n".join([start, *fields, b"", b""]))
        if fault is not None:
            self._refuse(fault)

    def handle_websocket_upgrade(self) -> None:
        self._connections.work(self)
        super().handle_websocket_upgrade()
        if self._write_timer is not None:
            self._write_timer.cancel()
        protocol: object = self.transport.get_protocol()
        if isinstance(protocol, WebSocketConnection):
            protocol.came_from(self)
            if self.flow.write_paused:  # because of the answer before
                self.transport.set_write_buffer_limits()
                protocol.pause_writing()

    # Refusals

    def _refuse(self, fault: Fault) -> None:
        self._refusal = fault
        raise _Refused

    def _head_too_slow(self) -> None:
        self._head_timer = None
        if self.transport.is_closing():
            return
        if self._in_message and not self._in_head and not self._is_working():
            self._end("unread-body")
        elif not self._in_head and not self._is_working():
            self._end("silent")
        else:
            self._refusal = HeadTooSlow("The head of the request did not arrive in time.")
            self.send_400_response("")

    def send_400_response(self, msg: str) -> None:
        """Refuse a request that the application does not see, after the answers that are still due, and close."""
        if self._stopped_reading:
            return
        # The parser wraps exceptions that its callbacks raise.
        within = getattr(sys.exception(), "__context__", None)
        fault: Exception = self._refusal or MalformedHead("The bytes that were sent are not an HTTP/1.1 request.")
        if isinstance(within, MemoryError | OSError):
            fault = declared(within)
        problem = problem_of(fault, request_id=secrets.token_hex(16))
        reason = problem.type.rpartition(":")[2]
        self._connections.ended(reason)
        client = self.client[0] if self.client else None
        log.info("refused", extra={"request_id": problem.request_id, "problem": reason, "client": client})
        working = self._is_working()
        self._stop_listening()
        if working and self._in_message and not self._in_head and not self.pipeline:
            # The rest of this request is broken: its handler is notified that the client is gone.
            self.cycle.disconnected = True
            self.cycle.message_event.set()
            if self.cycle.response_started:
                self.transport.abort()
                return
        elif working:  # that request is answered first; then the connection closes
            return
        body = problem.model_dump_json(exclude_none=True).encode()
        fields: dict[str, str] = dict(getattr(fault, "headers", {}))
        if isinstance(fault, RETRY_LATER):
            fields["Retry-After"] = retry_after(fault)
        more = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
        head = (
            f"HTTP/1.1 {problem.status} {http.HTTPStatus(problem.status).phrase}\r\n"
            f"Content-Type: {MEDIA_TYPE}\r\nContent-Length: {len(body)}\r\nX-Request-Id: {problem.request_id}\r\n"
            f"{more}Connection: close\r\n\r\n"
        )
        self.transport.write(head.encode() + body)
        if self.transport.can_write_eof():
            self.transport.write_eof()
        if self._end_timer is not None:
            self._end_timer.cancel()
        self._end_timer = self.loop.call_later(LINGER_SECONDS, self._close)

    def _stop_listening(self) -> None:
        """Read nothing more; the connection closes after the last answer that is still due."""
        self._stopped_reading = True
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None
        if self._is_working():
            self.cycle.keep_alive = False

    # Outgoing

    def _watch_rest(self) -> None:
        """Have ``pause_writing`` called now if anything is unread, and ``resume_writing`` when all is read."""
        if self.transport.get_write_buffer_size():
            self.transport.set_write_buffer_limits(high=0)

    def pause_writing(self) -> None:
        super().pause_writing()
        self._unwritten = untaken(self.transport)
        self._write_timer = self.loop.call_later(self._settings.write_timeout, self._check_progress)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = None
        self.transport.set_write_buffer_limits()
        if not (self._stopped_reading or self.transport.is_closing() or self._is_working() or self.pipeline):
            self._await_request()

    def _check_progress(self) -> None:
        left = untaken(self.transport)
        if self._unwritten - left < LEAST_PROGRESS:
            self._connections.ended("write-timeout")
            self.transport.abort()
            return
        self._unwritten = left
        self._write_timer = self.loop.call_later(self._settings.write_timeout, self._check_progress)
