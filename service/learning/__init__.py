"""What a map learns from the runs of its robots: notes of a run while it lasts, and its lesson once it is over."""
