"""Frames that a map keeps because its answers were doubtful, and what people say that they show."""
