"""Searching a map: immutable snapshots in memory, and the indexes of large maps, which are built in the background."""
