"""A small planar world in which a robot drives by its camera; see ``docs/tutorials/from-bag-to-robot.md``."""
