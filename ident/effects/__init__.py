"""Effects beyond the declared model: a dictionary grouped by physics,
and the signals that they depend on.
"""
