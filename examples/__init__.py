"""Programs that show how the service is used; each is run from a checkout."""
