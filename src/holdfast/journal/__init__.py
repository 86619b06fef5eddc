"""What a run keeps: its journal, its tables, its directory, and which code made it."""
