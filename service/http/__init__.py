"""Between sockets and routes: connections, bodies, uploads, parameters, the OpenAPI document."""
