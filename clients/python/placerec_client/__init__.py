"""The client of placerec, a service that recognizes places: a camera frame goes in, the place comes out.

::

    from placerec_client import Client

    with Client("http://127.0.0.1:8000") as client:
        answer = client.maps["lab"].query("frame.jpg")
        print(answer.verdict, answer.place and answer.place.id)
"""

from placerec_client import models, parameters, problems
from placerec_client._async.client import AsyncClient
from placerec_client._async.jobs import AsyncJob
from placerec_client._async.maps import AsyncMap
from placerec_client._async.sessions import AsyncSession
from placerec_client._sync.client import Client
from placerec_client._sync.jobs import Job
from placerec_client._sync.maps import Map
from placerec_client._sync.sessions import Session
from placerec_client.errors import (
    ConnectionFailed,
    DeadlineExceeded,
    InvalidFrame,
    JobCancelled,
    PlacerecError,
    Problem,
    TransferFailed,
    UnexpectedAnswer,
)
from placerec_client.frames import Frame, Picture
from placerec_client.retry import Retry
from placerec_client.version import VERSION

__version__ = VERSION

__all__ = [
    "AsyncClient",
    "AsyncJob",
    "AsyncMap",
    "AsyncSession",
    "Client",
    "ConnectionFailed",
    "DeadlineExceeded",
    "Frame",
    "InvalidFrame",
    "Job",
    "JobCancelled",
    "Map",
    "Picture",
    "PlacerecError",
    "Problem",
    "Retry",
    "Session",
    "TransferFailed",
    "UnexpectedAnswer",
    "__version__",
    "models",
    "parameters",
    "problems",
]
