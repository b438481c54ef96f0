"""The thesis's pipeline written literally, to compare with."""
