"""Many cells' logs: grouped by cell, fitted side by side, and kept so that a second run does only what is new."""
