"""Sessions: a robot's run, frame by frame, as a belief over places."""
