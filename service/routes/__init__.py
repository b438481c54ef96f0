"""The HTTP resources, one module each."""

from service.routes import encoders, frames, maps, places, queries, root, sequences

ROUTERS = (
    root.router,
    maps.router,
    places.router,
    sequences.router,
    queries.router,
    frames.router,
    encoders.router,
)
