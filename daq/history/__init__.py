"""What became of a cell's calibrations: every one of them, which were applied, and whether gains drift."""
