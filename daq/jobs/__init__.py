"""Scheduled recalibration, and fits of many cells at once."""
