"""Looking after a map: what its own descriptors and the answers it gave say about it.  No storage, no HTTP."""
