"""The upkeep of a map: its weak points, by its own descriptors and answers.  No storage, no HTTP."""
