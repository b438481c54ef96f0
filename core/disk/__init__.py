"""Files and small SQLite databases that survive a crash and a power cut."""
