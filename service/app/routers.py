"""The HTTP resources, one module each."""

from service.app import encoder_routes as encoders
from service.app import root_routes as root
from service.frames import routes as frames
from service.jobs import routes as jobs
from service.maps import calibration_routes as calibration
from service.maps import camera_routes as cameras
from service.maps import routes as maps
from service.maps import transfer_routes as transfers
from service.places import routes as places
from service.places import traverse_routes as sequences
from service.queries import closure_routes as closures
from service.queries import explanation_routes as explanations
from service.queries import routes as queries
from service.queries import several_routes as several
from service.sessions import routes as sessions
from service.sessions import stream_routes as streams
from service.upkeep import routes as upkeep

ROUTERS = (
    queries.router,  # routes are tried in turn: the one that robots ask most comes first
    root.router,
    maps.router,
    places.router,
    sequences.router,
    cameras.router,
    calibration.router,
    closures.router,
    several.router,
    sessions.router,
    streams.router,
    explanations.router,
    frames.router,
    upkeep.router,
    transfers.router,
    jobs.router,
    encoders.router,
)
