"""Apply a calibration to a controller's file or to its drives, and undo it."""
