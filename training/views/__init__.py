"""What training draws of photographs: disturbed crops, and pairs of displaced views."""
