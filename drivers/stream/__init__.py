"""Frames in, samples out: capture, SYNC and grouping. No sample is lost silently."""
