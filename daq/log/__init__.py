"""MCAP logs: written without loss, read fast, salvaged, imported and exported."""
