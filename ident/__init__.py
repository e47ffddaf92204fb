"""Identify drive gains and dynamic parameters: arrays in, results out. No bus, no log, no clock."""
