"""The Python client beside the load tool."""
