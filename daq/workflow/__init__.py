"""Plan, record, fit, validate: the steps of a calibration."""
