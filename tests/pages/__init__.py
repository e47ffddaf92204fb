"""The commands and Python blocks of the documentation: which are run, and that those do."""
