"""Pictures of places: where each is, and the object store that may have them."""
