"""Tools that measure the repository itself."""
