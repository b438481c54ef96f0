"""Frames without a map: descriptors, regions, the score of two."""
