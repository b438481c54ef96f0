"""The place recognition systems that ours is compared with: those of the thesis, and the one shape they all have."""
