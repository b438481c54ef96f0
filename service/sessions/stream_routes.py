"""A run over one WebSocket: frames one way, answers the other, without a request for each.

Messages from the robot: a text message (JSON, the parameters of a frame; optional) and then a binary one, the frame.
Messages to the robot: one text message for each frame, in their order, the answer or {"problem": …}.  A frame whose
parameters were refused has had its message, and is not taken in.  The next frame is read when the last one is
answered, so that a robot that is too fast is held back by its own connection.
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
from starlette.websockets import WebSocketDisconnect, WebSocketState

from core.errors import PlacerecError
from core.places import check_map_id
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
from service.errors.problems import Problem, problem_of, problem_response
from service.http.bodies import parse_json
from service.http.schemas import validated
from service.http.uploads import check_frame
from service.sessions.frames import take_in
from service.sessions.schemas import FrameParameters
from service.sessions.sessions import Session, Sessions
from service.worker_threads import in_thread

router = APIRouter()

POLICY_VIOLATION = 1008


@router.websocket("/v1/maps/{map}/sessions/{session}/stream")
async def stream_frames(socket: WebSocket) -> None:
    """Take in the frames of a run as they come, until the robot closes the connection or the session ends."""
    state = socket.app.state
    engine: Engine = state.engine
    sessions: Sessions = state.sessions
    try:
        map_id, session_id = check_map_id(socket.path_params["map"]), socket.path_params["session"]
        map_ = await engine.map(map_id)
        session = await in_thread(sessions.find, map_, session_id)
        if session.streaming:
            raise StreamTaken("Another connection streams into this session; close that one first.")
    except (Fault, PlacerecError) as error:
        await socket.send_denial_response(_refusal(socket, error))
        return
    session.streaming = True
    try:
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            await _serve(socket.app.state, map_id, session, socket)
    finally:
        session.streaming = False


async def _serve(state: State, map_id: str, session: Session, socket: WebSocket) -> None:
    told: dict[str, Any] | None = None
    refused = False
    while True:
        try:
            async with asyncio.timeout(session.expires_after):
                message = await socket.receive()
        except TimeoutError:
            await socket.close(POLICY_VIOLATION, "No frame came for too long.")
            return
        if message["type"] != "websocket.receive":
            return
        try:
            if message.get("bytes") is None:
                previous, told, refused = told, None, True
                if previous is not None:
                    raise InvalidRequest("Two text messages came without a frame between them; both are dropped.")
                told, refused = _parameters(message.get("text") or "", state.engine), False
                continue
            given, told = told, None
            if refused:
                refused = False
                continue
            await socket.app.state.gate.turn(socket.scope)
            answer = await _answer(state, map_id, session, message["bytes"], given or {})
        except (Fault, PlacerecError) as error:
            await _tell(socket, error)
            if isinstance(error, UnknownSession | SessionExpired):
                await socket.close(POLICY_VIOLATION, "The session is over.")
                return
            if isinstance(error, KeyNeeded | KeyRefused | KeysUnreadable | ForeignPage):
                await socket.close(POLICY_VIOLATION, "The key is not valid any more.")
                return
            continue
        if socket.application_state is WebSocketState.CONNECTED:
            await socket.send_text(answer)


async def _answer(state: State, map_id: str, session: Session, data: bytes, given: dict[str, Any]) -> str:
    options, engine = validated(FrameParameters, given), state.engine
    if len(data) > engine.settings.max_image_bytes:
        raise BodyTooLarge(f"The frame has more than {engine.settings.max_image_bytes} bytes.")
    check_frame(data, None)
    map_ = await engine.map(map_id)
    await in_thread(state.sessions.find, map_, session.id)
    deadline = RequestDeadline(time.monotonic() + engine.settings.request_timeout, _never)
    answer = await take_in(engine, state.sessions, state.statistics, map_, session, data, options, deadline, None)
    return answer.model_dump_json()


def _parameters(text: str, engine: Engine) -> dict[str, Any]:
    if len(text) > engine.settings.max_json_bytes:
        raise BodyTooLarge(f"The message has more than {engine.settings.max_json_bytes} characters.")
    found = parse_json(text, "The message")
    if not isinstance(found, dict):
        raise MalformedBody("The message is not a JSON object.")
    return found


async def _never() -> None:
    """A robot that hangs up is noticed when it is answered; its frame counts all the same."""
    await asyncio.Event().wait()


async def _tell(socket: WebSocket, error: Exception) -> None:
    problem: Problem = problem_of(error, socket.scope["path"], socket.scope["state"]["request_id"])
    await socket.send_json({"problem": problem.model_dump(exclude_none=True)})


def _refusal(socket: WebSocket, error: Exception) -> Response:
    """The problem as the answer to the handshake."""
    return problem_response(Request({**socket.scope, "type": "http", "method": "GET"}), error)
