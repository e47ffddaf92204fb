"""The audit log of every write, and the history of a cell's calibrations."""
