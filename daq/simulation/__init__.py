"""The simulated cell as a file, and the demonstration on it.

Nothing that fits, plans or reports imports this room.
"""
