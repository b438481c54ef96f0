"""Backups of all maps: as `placerec backup` makes them, and by the service itself, at intervals."""
