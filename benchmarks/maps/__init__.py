"""Searches of maps: by size, precision, filters, and along sequences."""
