"""Estimators of gains and parameters, and their error bars."""
