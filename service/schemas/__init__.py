"""The JSON that the service takes and gives, one module a resource."""
