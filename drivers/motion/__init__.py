"""Moves of a cell, and everything that stops them."""
