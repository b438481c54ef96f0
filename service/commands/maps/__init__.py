"""``placerec maps`` and ``placerec backup``."""
