"""Jobs: long work in the background."""
