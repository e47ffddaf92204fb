"""Checks that a calibration must pass before anything is written."""
