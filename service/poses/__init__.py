"""Poses for others: as OGC GeoPoses, and whether a pose is in a map."""
