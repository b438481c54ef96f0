"""The client of placerec, a service that recognizes places: a camera frame goes in, the place comes out.

::

    from placerec_client import Client

    with Client("http://127.0.0.1:8000") as client:
        answer = client.maps["lab"].query("frame.jpg")
        print(answer.verdict, answer.place and answer.place.id)

Unused parts, such as the asynchronous half, are not imported.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from placerec_client.version import VERSION

if TYPE_CHECKING:
    from placerec_client import models, parameters, problems
    from placerec_client._async.client import AsyncClient
    from placerec_client._async.jobs import AsyncJob
    from placerec_client._async.maps import AsyncMap
    from placerec_client._async.sessions import AsyncSession
    from placerec_client._sync.client import Client
    from placerec_client._sync.jobs import Job
    from placerec_client._sync.maps import Map
    from placerec_client._sync.sessions import Session
    from placerec_client.batches import Enrolled, Located, NewPlace
    from placerec_client.errors import (
        ClientClosed,
        ConnectionFailed,
        DeadlineExceeded,
        InvalidFrame,
        InvalidName,
        InvalidOdometry,
        InvalidParameter,
        JobCancelled,
        NotReadyInTime,
        PlacerecError,
        Problem,
        Renamed,
        TransferFailed,
        UnexpectedAnswer,
        UnreadableFile,
    )
    from placerec_client.events import MapEvent
    from placerec_client.frames import Frame, Picture
    from placerec_client.odometry import Odometry
    from placerec_client.retry import Retry

__version__ = VERSION

__all__ = [
    "AsyncClient",
    "AsyncJob",
    "AsyncMap",
    "AsyncSession",
    "Client",
    "ClientClosed",
    "ConnectionFailed",
    "DeadlineExceeded",
    "Enrolled",
    "Frame",
    "InvalidFrame",
    "InvalidName",
    "InvalidOdometry",
    "InvalidParameter",
    "Job",
    "JobCancelled",
    "Located",
    "Map",
    "MapEvent",
    "NewPlace",
    "NotReadyInTime",
    "Odometry",
    "Picture",
    "PlacerecError",
    "Problem",
    "Renamed",
    "Retry",
    "Session",
    "TransferFailed",
    "UnexpectedAnswer",
    "UnreadableFile",
    "__version__",
    "models",
    "parameters",
    "problems",
]

_MODULES = {
    "_async.client": ("AsyncClient",),
    "_async.jobs": ("AsyncJob",),
    "_async.maps": ("AsyncMap",),
    "_async.sessions": ("AsyncSession",),
    "_sync.client": ("Client",),
    "_sync.jobs": ("Job",),
    "_sync.maps": ("Map",),
    "_sync.sessions": ("Session",),
    "batches": ("Enrolled", "Located", "NewPlace"),
    "errors": (
        *("ClientClosed", "ConnectionFailed", "DeadlineExceeded", "InvalidFrame", "InvalidName", "InvalidOdometry"),
        *(
            "InvalidParameter",
            "JobCancelled",
            "NotReadyInTime",
            "PlacerecError",
            "Problem",
            "Renamed",
            "TransferFailed",
            "UnexpectedAnswer",
            "UnreadableFile",
        ),
    ),
    "events": ("MapEvent",),
    "frames": ("Frame", "Picture"),
    "odometry": ("Odometry",),
    "retry": ("Retry",),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name when it is first used."""
    if name in ("models", "parameters", "problems"):
        return import_module(f"{__name__}.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
