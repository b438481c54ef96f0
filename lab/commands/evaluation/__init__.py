"""``placerec evaluate``."""
