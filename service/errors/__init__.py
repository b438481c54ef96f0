"""The errors of the service, and the problems with which it answers them."""
