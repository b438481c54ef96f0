"""Encoders in a Ray cluster: what they cost, and how far one front carries them."""
