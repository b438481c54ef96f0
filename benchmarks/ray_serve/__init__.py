"""Encoders in a Ray cluster: their cost, and how far one front carries them."""
