"""The place recognition systems of the literature that ours is compared with, and the shape that all systems share."""
