"""A map's SQLite database: its connections, tables, statements and log."""
