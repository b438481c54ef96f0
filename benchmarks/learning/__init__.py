"""A year in which maps learn from their robots."""
