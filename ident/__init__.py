"""The science: arrays in, results out. No bus, no log, no clock."""
