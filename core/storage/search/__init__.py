"""What of a map is searched: immutable snapshots in memory, and the indexes that large maps are searched by."""
