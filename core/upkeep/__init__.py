"""The upkeep of a map: what its own descriptors and its answers say about its weak points.  No storage, no HTTP."""
