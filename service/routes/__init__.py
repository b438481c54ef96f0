"""The HTTP resources, one module each."""

from service.routes import (
    calibration,
    cameras,
    closures,
    encoders,
    explanations,
    frames,
    jobs,
    maps,
    places,
    queries,
    root,
    sequences,
    sessions,
    several,
    streams,
    transfers,
    upkeep,
)

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
