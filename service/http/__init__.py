"""HTTP, from the socket to the routes.

A request passes these modules in order: ``server`` listens, ``connections`` limits how many connections there are,
``http_connection`` parses requests (``websocket_connection`` takes over a WebSocket), ``bodies`` limits and times
the bytes that arrive, ``routing`` has the parts of routes, and ``uploads`` and ``multipart`` read frames from the body.
"""
