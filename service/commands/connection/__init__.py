"""How commands speak to a service."""
