"""What clients of the service cost beside plain HTTP."""
