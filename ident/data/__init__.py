"""Runs in SI units, filtered and differentiated."""
