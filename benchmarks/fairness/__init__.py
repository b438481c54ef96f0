"""How one robot is served while the key of another takes all that it can get."""
