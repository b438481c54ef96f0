"""The cost of clients of the service beside plain HTTP."""
