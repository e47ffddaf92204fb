"""Files that people write: cells, drives, imports, simulations."""
