"""The calibration goes home: what would change, which gates are closed, and the change itself."""
