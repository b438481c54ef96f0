"""The application: its routes, its middleware, and the runtime that lives while it runs."""

from __future__ import annotations

import importlib.metadata
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, nullcontext
from functools import cache
from typing import Any

from anyio import to_thread
from fastapi import FastAPI, Request
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from core.disk.reserve import lend_from
from service.access.gate import Access, Gate, endpoints_of, warn_if_exposed
from service.access.keyring import Keyring
from service.access.keys import Keys
from service.access.rates import Rates
from service.administration import audit_routes, key_routes
from service.administration.audit_trail import audit_trail
from service.app import load_history, service_state
from service.app import routes as root
from service.app.gauges import gauges
from service.app.runtime import Runtime
from service.backups import routes as backups
from service.console import routes as console
from service.errors.faults import KeysUnreadable
from service.errors.problems import install_problems, problem_response
from service.events.schemas import EnrolmentEvent, JobEvent, Listening, MapEvent, Missed, QueryEvent, SessionEvent
from service.fairness import RefusalPace
from service.frames import routes as frames
from service.http.bodies import BodyLimit, UploadMemory
from service.http.openapi import document
from service.http.text_form import TextForm
from service.jobs import routes as jobs
from service.maps import calibration, calibration_preview, camera_routes, event_routes, transfer_routes
from service.maps import routes as maps
from service.maps.schemas import CalibrationOrder
from service.places import looks, plan_routes
from service.places import routes as places
from service.places.parameters import BatchItem
from service.poses import routes as poses
from service.poses.geoposes import GeoPose
from service.queries import answer_routes, loop_closure, multi_map_routes
from service.queries import routes as queries
from service.recordings import routes as recordings
from service.review import learnt_looks, stretches
from service.review import routes as review
from service.sessions import routes as sessions
from service.sessions import stream_routes
from service.settings import Settings, read_settings
from service.shared import open_database
from service.telemetry.metrics import Metrics
from service.telemetry.requests import Telemetry
from service.upkeep import fleet, similarity
from service.upkeep import routes as upkeep

SUMMARY = "Visual place recognition: a camera frame goes in, the place comes out, or an honest 'unknown'."
DESCRIPTION = """\
Enrol the frames of a traverse as the places of a map, then ask where another frame was taken.

A frame is sent as the raw body (`image/jpeg`, `image/png`, `image/webp`) with its parameters in the query \
string, or as `multipart/form-data` with one file part and the same parameters as fields. A 2xx answer to a write \
means that it is on disk and found by every later query; a request that got no answer can be sent again.

The service uses the `X-Request-Id` of a request, or makes one. `X-Request-Timeout` (seconds) drops a request that \
cannot be answered in time. An answer with `Retry-After` asks the client to send the request again later.

As soon as a key has been created, every request needs one: `Authorization: Bearer placerec_…`. \
Each operation names the role that its key needs: `query`, `enrol` (may also query) or `admin` (may do everything).
"""
TAGS = [
    {"name": "maps", "description": "A map is one environment, bound for life to one encoder."},
    {"name": "places", "description": "A place is one enrolled reference frame."},
    {"name": "sequences", "description": "A sequence is one traverse: it is listed and deleted as a whole."},
    {"name": "cameras", "description": "A camera has a mask: which part of its frames is ignored."},
    {"name": "queries", "description": "A query is one frame, answered with ranked matches and a verdict."},
    {
        "name": "calibration",
        "description": "A calibration decides when a map's answers are believed; it is measured on the map itself.",
    },
    {"name": "sessions", "description": "A session is a robot's run: a belief over places that every frame updates."},
    {
        "name": "review",
        "description": "Frames that a map has stored because its answers were doubtful, with labels.",
    },
    {"name": "frames", "description": "The encoder applied to frames, without a map."},
    {
        "name": "upkeep",
        "description": "Re-encoding, rebuilding, health, similarity, pruning, merging of maps.",
    },
    {"name": "transfer", "description": "Maps as files, to back them up, restore them or move them."},
    {"name": "jobs", "description": "A job is long work in the background; it reports its progress."},
    {"name": "encoders", "description": "The models and vocabularies that are installed."},
    {"name": "keys", "description": "A key identifies the caller, and sets its holder's rights and maps."},
    {"name": "audit", "description": "The audit trail says who changed what, and who was refused."},
    {"name": "service", "description": "Health, metrics and version of the service."},
]

ROUTERS = (
    queries.router,  # routes are tried in this order, so the most frequent one comes first
    root.router,
    maps.router,
    places.router,
    places.traverses,
    recordings.router,
    looks.router,
    learnt_looks.router,
    plan_routes.router,
    poses.router,
    camera_routes.router,
    event_routes.router,
    calibration.router,
    calibration_preview.router,
    loop_closure.router,
    multi_map_routes.router,
    sessions.router,
    stream_routes.router,
    fleet.router,
    queries.explanations,
    review.router,
    stretches.router,
    answer_routes.router,
    frames.router,
    upkeep.router,
    similarity.router,
    transfer_routes.router,
    backups.router,
    jobs.router,
    key_routes.own,
    key_routes.router,
    audit_routes.router,
    service_state.router,
    load_history.router,
    root.encoders,
    console.router,
)


EVENTS = (Listening, Missed, QueryEvent, EnrolmentEvent, SessionEvent, JobEvent, MapEvent)


class Application(FastAPI):
    """FastAPI with an OpenAPI document that also says what every operation can answer."""

    def openapi(self) -> dict[str, Any]:
        """The document, with the models of bodies that routes read by hand, of other answers, and of events."""
        return document(self, (BatchItem, CalibrationOrder, GeoPose, *EVENTS))


class RootPath:
    """ASGI middleware that sets the path under which a proxy publishes the application.

    Args:
        root_path: for example /placerec; requests may come with it or, if the proxy removes it, without it.
    """

    def __init__(self, app: ASGIApp, root_path: str) -> None:
        self.app, self.root_path = app, root_path

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            path: str = scope["path"]
            if not path.startswith(self.root_path + "/"):
                path = self.root_path + path
            scope = {**scope, "root_path": self.root_path, "path": path}
        await self.app(scope, receive, send)


async def _method_not_allowed(request: Request, _error: Exception) -> Response:
    """Answer 405 with all methods of the resource; the framework would name those of one route only."""
    path = request.scope["path"].removeprefix(request.scope["root_path"])
    routes = [one for router in ROUTERS for one in router.routes if isinstance(one, APIRoute)]
    found = [route for route in routes if route.path_regex.match(path)]
    literal = [route for route in found if route.path == path]  # /v1/maps/import is no map
    known = {method for route in literal or found for method in route.methods or ()}
    known |= {"HEAD"} if "GET" in known else set()
    allowed = ", ".join(sorted(known))
    detail = f"The method {request.scope['method'][:20]} is not allowed here; allowed are {allowed}."
    return problem_response(request, HTTPException(405, detail, {"Allow": allowed}))


class WholeSegments:
    """ASGI middleware that has nothing at a path with a slash inside a segment (``%2F``).

    Servers decode a path before it is taken apart, and so do some proxies: such a name would choose another operation.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        has_slash = b"%2f" in (scope.get("raw_path") or b"").lower()  # which a server may leave out, or None
        await (_not_found if has_slash else self.app)(scope, receive, send)


async def _not_found(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer 404 if a path has no route; the framework would answer a WebSocket with an empty 403."""
    error = HTTPException(404)
    if scope["type"] != "websocket":
        raise error
    answer = problem_response(Request({**scope, "type": "http", "method": "GET"}), error)
    await WebSocket(scope, receive, send).send_denial_response(answer)


def _has_keys(store: Keys) -> bool:
    """Whether a key was ever created; taken for granted while that cannot be known, for then nobody is let in."""
    try:
        return store.exists()
    except KeysUnreadable:
        if not store.place.remote:
            raise
        return True


@cache
def _routes() -> tuple[BaseRoute, ...]:
    """All routes, which applications share; an operation has the name of its function.

    No router includes those of the modules: FastAPI would analyse each route again, a fifth of a second together.
    """
    routes = [route for router in ROUTERS for route in router.routes]
    for route in routes:
        if isinstance(route, APIRoute):
            route.operation_id = route.name
    return tuple(routes)


def create_app(settings: Settings | None = None, *, as_owner: bool = False) -> FastAPI:
    """Create the application; nothing is opened or loaded before it starts.

    Args:
        settings: read from the environment if left out.
        as_owner: no request needs a key.  This is for a client in the same process, which can read the disk anyway;
            never for a server.

    Raises:
        SettingsError: a setting is wrong, or would expose the service without keys.
        KeysUnreadable: the file of keys cannot be read.
        MissingExtra: the state is in PostgreSQL, and what speaks to it is not installed.
    """
    chosen = settings if settings is not None else read_settings()
    lend_from(chosen.data_dir)
    database = open_database(chosen)
    store = Keys.of(chosen.data_dir, database)
    chosen.check_exposure(has_keys=not as_owner and _has_keys(store))
    may_open = chosen.is_loopback() or chosen.allow_anonymous
    keyring = None if as_owner else Keyring(store, may_open=may_open)
    metrics = Metrics()
    rates = Rates(chosen.rate_per_key, chosen.rate_burst, database)
    gate = Gate(keyring, rates, chosen.is_loopback(), chosen.host_names())

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        to_thread.current_default_thread_limiter().total_tokens = chosen.storage_threads
        with audit_trail(chosen.audit_file) as trail, database or nullcontext(), keyring or nullcontext(), rates:
            app.state.audit_trail = trail
            warn_if_exposed(gate, chosen)
            runtime = await to_thread.run_sync(Runtime, chosen, metrics, database, keyring)
            runtime.publish(app.state)
            runtime.start()
            try:
                with gauges(runtime, app.state.upload_memory):
                    yield
            finally:
                await runtime.close()

    app = Application(
        title="placerec",
        version=importlib.metadata.version("placerec"),
        summary=SUMMARY,
        description=DESCRIPTION,
        openapi_tags=TAGS,
        openapi_url=None,  # service.app.routes serves the document and a page that loads nothing from other sites
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        lifespan=lifespan,
    )
    pace = RefusalPace()
    install_problems(app, pace)
    app.add_exception_handler(405, _method_not_allowed)
    app.router.routes.extend(_routes())
    app.router.default = _not_found
    app.router.middleware_stack = WholeSegments(app.router.middleware_stack)  # where a 404 is answered as a problem
    app.state.gate, app.state.key_store = gate, store
    app.state.metrics, app.state.upload_memory = metrics, UploadMemory(chosen.max_upload_memory)
    app.add_middleware(BodyLimit, settings=chosen, memory=app.state.upload_memory)
    app.add_middleware(Access, gate=gate, endpoints=endpoints_of(app.routes), metrics=metrics, pace=pace)
    app.add_middleware(Telemetry, metrics=metrics)
    app.add_middleware(TextForm)
    if chosen.root_path:
        app.add_middleware(RootPath, root_path=chosen.root_path)  # the outermost middleware is added last
    return app
