"""Predict how well an experiment identifies each gain, and keep the arm clear of obstacles."""
