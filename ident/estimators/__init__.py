"""The estimators, each on the same System."""
