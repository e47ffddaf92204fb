"""Columns of the inverse dynamic model (paper eqs. 1 and 25)."""
