"""A map's files on disk: written so that power may fail, checked when they are read."""
