"""Record cells, fit logs, apply calibrations: the service behind the command `drivegain`."""
