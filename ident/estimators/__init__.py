"""The estimators, each on the same Observation."""
