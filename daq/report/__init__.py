"""Pictures and tables of a calibration: arrays and labels in, a PNG or a table out."""
