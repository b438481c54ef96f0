"""The application: its lifetime, its routes at the root, and the page that documents its interface."""
