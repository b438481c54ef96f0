"""The synchronous half of the client, written from the asynchronous one by scripts/client."""
