"""What training draws of photographs: disturbed crops, pairs of displaced views, and pairs of neighbouring frames."""
