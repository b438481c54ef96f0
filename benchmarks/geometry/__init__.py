"""The gain and the cost of geometric verification."""
