"""Changes of gains between calibrations: single changes, drift and alarms."""
