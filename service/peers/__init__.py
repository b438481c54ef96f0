"""The other services with which one shares its state, if there are any."""
