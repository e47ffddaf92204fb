"""Frames in, samples out: SYNC and grouping. No sample is lost silently."""
