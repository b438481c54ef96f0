"""The thesis's method: regions, vocabulary, VLAD, matching, agreement, and the encoders made of them."""
