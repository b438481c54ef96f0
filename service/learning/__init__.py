"""Learning from the runs of robots: notes of a run while it lasts, and its lesson once it is over."""
