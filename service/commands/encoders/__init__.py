"""Commands that make encoders of pictures."""
