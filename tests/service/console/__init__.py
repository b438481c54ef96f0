"""The console, driven in a browser against a real service."""
