"""A robot's run, frame by frame."""
