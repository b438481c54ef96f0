"""The parts of a map in PostgreSQL and Milvus besides its places and searches (:mod:`core.maps`)."""
