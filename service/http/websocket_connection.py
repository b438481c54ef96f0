"""One WebSocket: uvicorn's protocol, with limits on the messages that wait, and a shutdown between two messages.

uvicorn sends a ping every 20 seconds and closes the connection of a client that does not answer it for as long.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import SecurityError
from websockets.frames import Frame
from websockets.http11 import Request
from websockets.server import ServerProtocol

from service.errors.faults import Fault, HeadTooLarge, MalformedHead, MemoryFull
from service.fairness import Holding
from service.http.connections import Connection, Connections

UNKNOWN = "unknown"

INVALID_DATA, POLICY_VIOLATION, TRY_AGAIN_LATER, RESTARTING = 1007, 1008, 1013, 1012


PROBE = "placerec.probe"
"""The extension of a WebSocket's scope that finds out whether its client is there (:meth:`WebSocketConnection.probe`).
"""


def handshake_fault(head: bytes) -> Fault | None:
    """Why the websockets library would refuse a request as a handshake; None if it would accept it.

    It is checked beforehand because its own refusal is no problem object, or no answer at all and an open connection.
    """
    judge = ServerProtocol()
    judge.receive_data(head)
    for event in judge.events_received():
        if isinstance(event, Request):
            judge.accept(event)
    if judge.handshake_exc is None:
        return None
    if isinstance(judge.handshake_exc, SecurityError):
        return HeadTooLarge("The WebSocket handshake has too many headers, or a line of more than 8 KiB.")
    return MalformedHead(
        "This is not a valid WebSocket handshake. Send an HTTP/1.1 GET without a body, with Sec-WebSocket-Version: 13 "
        "and 16 bytes in base64 as Sec-WebSocket-Key.",
        {"Sec-WebSocket-Version": "13"},
    )


def _is_utf_8(text: bytes) -> bool:
    try:
        text.decode()
    except UnicodeDecodeError:
        return False
    return True


class WebSocketConnection(WebSocketsSansIOProtocol):
    """A WebSocket that holds a bounded number of messages, of fragments and of bytes.

    Args:
        connections: the register of all connections, with the limits.
        more: uvicorn's own arguments of a protocol.
    """

    def __init__(self, *, connections: Connections, **more: Any) -> None:
        super().__init__(**more)
        self.logger = logging.getLogger("uvicorn.streams")  # uvicorn's own logger would log whole query strings
        self._connections, self._settings = connections, connections.settings
        self._origin: Connection | None = None
        self._at_work = self._stopping = False
        self._arriving = 0  # bytes of the unfinished message
        self._held = deque[int]()  # bytes of the message at work and of each one that waits
        self._write_timer: asyncio.TimerHandle | None = None
        self._holding: Holding | None = None
        self._heard = asyncio.Event()

    def came_from(self, origin: Connection) -> None:
        """Take over the entry of the connection that requested the upgrade in the register."""
        self._origin = origin
        self._connections.stream(self)
        # Nothing is read until the handshake is answered; the first ``receive`` resumes reading.
        self.read_paused = True
        self.transport.pause_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._origin is not None:
            self._connections.leave(self._origin, self)
        if self._write_timer is not None:
            self._write_timer.cancel()
        self._connections.memory.release(self._room())
        self._arriving = 0
        self._held.clear()
        super().connection_lost(exc)

    def handle_connect(self, event: Request) -> None:
        super().handle_connect(event)
        if not self.conn.handshake_exc:
            extensions: Any = {**(self.scope.get("extensions") or {}), PROBE: self.probe}
            self.scope["extensions"] = extensions

    async def probe(self, seconds: float) -> bool:
        """Whether the client is there: it answers a ping within some seconds, or has sent something that waits.

        The connection to a client that is not is ended.
        """
        if self.read_paused or self._at_work or not self.handshake_complete:
            return not self.transport.is_closing()
        self._heard.clear()
        self.conn.send_ping(b"probe")
        self.transport.write(b"".join(self.conn.data_to_send()))
        try:
            async with asyncio.timeout(seconds):
                await self._heard.wait()
        except TimeoutError:
            self._connections.ended("lost")
            self.transport.abort()
            return False
        return not self.transport.is_closing()

    # Incoming

    def data_received(self, data: bytes) -> None:
        self._heard.set()
        if self.close_sent and self.close_timer is None:
            return  # refused
        if not self.handshake_initiated:  # the head, which is not counted as held
            super().data_received(data)
            if not self.handshake_initiated:  # refused although ``handshake_fault`` found nothing
                self.transport.abort()
            return
        try:
            self._connections.memory.hold(self._room(), len(data))
        except MemoryFull:
            self._fail(TRY_AGAIN_LATER, "memory-full")
            return
        self._arriving += len(data)
        super().data_received(data)
        # Bytes of no message, such as those of a ping, are held no longer.
        left = len(self.conn.reader.buffer) + sum(map(len, self.frames))
        self._connections.memory.release(self._room(), self._arriving - left)
        self._arriving = left

    def _room(self) -> Holding:
        """The bytes of its messages that are held in memory, which are its caller's as soon as that is known."""
        if self._holding is None:
            caller = self.scope.get("state", {}).get("caller", UNKNOWN) if self.handshake_initiated else UNKNOWN
            self._holding = Holding(self._give_way, caller=caller)
        return self._holding

    def _give_way(self) -> bool:
        self._fail(TRY_AGAIN_LATER, "memory-full")
        return True

    def handle_cont(self, event: Frame) -> None:
        if len(self.frames) >= self._settings.max_stream_fragments:
            self._fail(POLICY_VIOLATION, "too-many-fragments")
            return
        super().handle_cont(event)

    def send_receive_event_to_app(self) -> None:
        if self.close_sent:  # the service has sent its close frame and waits only for the client's
            super().send_receive_event_to_app()
            return
        if self.queue.qsize() >= self._settings.max_stream_messages:
            self._fail(POLICY_VIOLATION, "too-many-messages")
            return
        if self.curr_msg_data_type == "text" and not _is_utf_8(b"".join(self.frames)):
            self._fail(INVALID_DATA, "invalid-text")
            return
        size = sum(map(len, self.frames))
        self._held.append(size)
        self._arriving -= size
        super().send_receive_event_to_app()

    def _fail(self, code: int, reason: str) -> None:
        if self.close_sent or self.transport.is_closing():
            return
        self._connections.ended(reason)
        self.stop_keepalive()
        self.conn.fail(code, reason)
        self.handle_parser_exception()

    async def receive(self) -> Any:
        if self._at_work and self._held:
            self._connections.memory.release(self._room(), self._held.popleft())
        self._at_work = False
        if self._stopping and self.handshake_complete:
            self._say_restarting()
            return {"type": "websocket.disconnect", "code": RESTARTING}
        message = await super().receive()
        self._at_work = message["type"] == "websocket.receive"
        return message

    def shutdown(self) -> None:
        """Answer the message or the handshake that is at work, then close with the code for a restart."""
        if (self._at_work or not self.handshake_complete) and not self.close_sent:
            self._stopping = True
        else:
            self._say_restarting()

    def _say_restarting(self) -> None:
        if not self.transport.is_closing():  # else the client has closed first
            super().shutdown()

    # Outgoing

    async def send(self, message: Any) -> None:
        await super().send(message)
        if message["type"] == "websocket.http.response.body" and not message.get("more_body", False):
            self.handshake_complete = True  # a refusal completes it too; otherwise uvicorn logs an error

    def pause_writing(self) -> None:
        super().pause_writing()
        self.transport.pause_reading()  # otherwise answers to pings would pile up
        self._write_timer = self.loop.call_later(self._settings.write_timeout, self._give_up)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = None
        if not self.read_paused and not self.transport.is_closing():
            self.transport.resume_reading()

    def _give_up(self) -> None:
        self._connections.ended("write-timeout")
        self.transport.abort()
