"""A map's SQLite database: its tables, its statements, its log."""
