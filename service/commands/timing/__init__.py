"""How long recognition takes on this machine, and frames and maps to time it with."""
