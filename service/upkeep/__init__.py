"""Looking after maps: health, pruning, merging, re-encoding."""
