"""The thesis's method: regions, vocabulary, VLAD, matching, agreement, and the encoders made of them."""

DEFAULT_ENCODER = "m-region-vlad"
"""The packaged encoder that is used where no other is named; here, so that its name costs no import of torch."""
