"""Frames without a map: descriptors, regions, and the score of two frames."""
