"""The route of a stream: the frames and answers of a session over one WebSocket, without a request for each frame.

The robot sends, for each frame, an optional text message (JSON, the frame's parameters) and a binary message (the
frame).  The service sends one text message for each frame, in order: the answer or {"problem": …}.  If the parameters
of a frame are refused, that is the message for the frame, and the frame does not count.  The next frame is read only
when the last one is answered, so a robot that sends too fast is slowed down by its own connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import Any

from fastapi import APIRouter, WebSocket
from starlette.datastructures import State
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Message
from starlette.websockets import WebSocketDisconnect, WebSocketState

from core.errors import PlacerecError
from core.places import check_map_id
from service.access.roles import Principal
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.errors.faults import (
    BodyTooLarge,
    Fault,
    ForeignPage,
    InvalidRequest,
    KeyNeeded,
    KeyRefused,
    KeysUnreadable,
    MalformedBody,
    SessionExpired,
    StreamTaken,
    UnknownSession,
)
from service.errors.problems import Problem, is_confided, problem_of, problem_response
from service.http.bodies import parse_json
from service.http.event_stream import CHECK_SECONDS
from service.http.schemas import validated
from service.http.uploads import check_frame
from service.http.websocket_connection import PROBE
from service.sessions.frames import process_frame
from service.sessions.schemas import FrameParameters
from service.sessions.session import Session
from service.sessions.sessions import Sessions
from service.worker_threads import in_thread

router = APIRouter()

POLICY_VIOLATION = 1008

PROBE_SECONDS = 2.0
"""The client of a stream answers a ping within this time, or another connection may take the session over."""


@router.websocket("/v1/maps/{map}/sessions/{session}/stream")
async def stream_frames(socket: WebSocket) -> None:
    """Process the frames of a session until the robot closes the connection or the session ends."""
    state = socket.app.state
    engine: Engine = state.engine
    sessions: Sessions = state.sessions
    try:
        map_id, session_id = check_map_id(socket.path_params["map"]), socket.path_params["session"]
        map_ = await engine.map(map_id)
        session = await in_thread(sessions.find, map_, session_id)
        session.require(socket.scope["state"]["principal"])
        if session.streaming and not await _is_lost(session):
            raise StreamTaken("Another connection streams into this session; close that one first.")
    except (Fault, PlacerecError) as error:
        await socket.send_denial_response(_denial(socket, error))
        return
    session.streaming, session.probe = True, socket.scope.get("extensions", {}).get(PROBE)
    try:
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            await _serve(socket.app.state, map_id, session, socket)
    finally:
        session.streaming, session.probe = False, None


async def _is_lost(session: Session) -> bool:
    """Whether the connection that streams into a session has lost its client; it is ended then."""
    if session.probe is None or await session.probe(PROBE_SECONDS):
        return False
    until = time.monotonic() + PROBE_SECONDS
    while session.streaming and time.monotonic() < until:
        await asyncio.sleep(0.01)
    return not session.streaming


async def _received(socket: WebSocket, seconds: float) -> Message:
    """The next message; the caller's key is looked at while none comes.

    Raises:
        TimeoutError: none came within some seconds.
        Fault: the key is not valid any more.
    """
    waiting = asyncio.ensure_future(socket.receive())
    until = time.monotonic() + seconds
    try:
        while True:
            left = until - time.monotonic()
            await asyncio.wait({waiting}, timeout=min(max(left, 0), CHECK_SECONDS))
            if waiting.done():
                return waiting.result()
            if left <= 0:
                raise TimeoutError
            socket.app.state.gate.identify(socket.scope)
    finally:
        waiting.cancel()


async def _serve(state: State, map_id: str, session: Session, socket: WebSocket) -> None:
    parameters: dict[str, Any] | None = None  # of the next frame
    refused = False  # whether the parameters of the next frame were refused
    while True:
        try:
            message = await _received(socket, session.expires_after)
        except TimeoutError:
            await socket.close(POLICY_VIOLATION, "No frame came for too long.")
            return
        except Fault as error:
            await _send_problem(socket, error)
            await socket.close(POLICY_VIOLATION, "The key is not valid any more.")
            return
        if message["type"] != "websocket.receive":
            return
        try:
            if message.get("bytes") is None:
                previous, parameters, refused = parameters, None, True
                if previous is not None:
                    raise InvalidRequest("Two text messages came without a frame between them; both are dropped.")
                parameters, refused = _parameters(message.get("text") or "", state.engine), False
                continue
            given, parameters = parameters, None
            if refused:
                refused = False
                continue
            await socket.app.state.gate.turn(socket.scope)
            principal: Principal = socket.scope["state"]["principal"]
            answer = await _answer(state, map_id, session, message["bytes"], given or {}, principal)
        except (Fault, PlacerecError) as error:
            await _send_problem(socket, error)
            if isinstance(error, UnknownSession | SessionExpired):
                await socket.close(POLICY_VIOLATION, "The session is over.")
                return
            if isinstance(error, KeyNeeded | KeyRefused | KeysUnreadable | ForeignPage):
                await socket.close(POLICY_VIOLATION, "The key is not valid any more.")
                return
            continue
        if socket.application_state is WebSocketState.CONNECTED:
            await socket.send_text(answer)


async def _answer(
    state: State, map_id: str, session: Session, data: bytes, given: dict[str, Any], principal: Principal
) -> str:
    options, engine = validated(FrameParameters, given), state.engine
    if len(data) > engine.settings.max_image_bytes:
        raise BodyTooLarge(f"The frame has more than {engine.settings.max_image_bytes} bytes.")
    check_frame(data, None)
    map_ = await engine.map(map_id)
    await in_thread(state.sessions.find, map_, session.id)
    deadline = RequestDeadline(time.monotonic() + engine.settings.request_timeout, _never)
    parts = engine, state.sessions, state.statistics
    answer = await process_frame(*parts, map_, session, data, options, deadline, None, principal)
    return answer.model_dump_json()


def _parameters(text: str, engine: Engine) -> dict[str, Any]:
    if len(text) > engine.settings.max_json_bytes:
        raise BodyTooLarge(f"The message has more than {engine.settings.max_json_bytes} characters.")
    found = parse_json(text, "The message")
    if not isinstance(found, dict):
        raise MalformedBody("The message is not a JSON object.")
    return found


async def _never() -> None:
    """Never return: if a robot hangs up, its frame is still processed, and the answer is not delivered."""
    await asyncio.Event().wait()


async def _send_problem(socket: WebSocket, error: Exception) -> None:
    request_id, confided = socket.scope["state"]["request_id"], is_confided(socket.state)
    problem: Problem = problem_of(error, socket.scope["path"], request_id, confided)
    await socket.send_json({"problem": problem.model_dump(exclude_none=True)})


def _denial(socket: WebSocket, error: Exception) -> Response:
    """The answer to a handshake that is refused."""
    return problem_response(Request({**socket.scope, "type": "http", "method": "GET"}), error)
