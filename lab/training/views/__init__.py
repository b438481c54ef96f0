"""Training examples from photographs: disturbed crops, pairs of displaced views, and pairs of neighbouring frames."""
