"""Hostile input, drawn from a seed: damaged pictures, the whole interface, raw HTTP, streams, parsers."""
