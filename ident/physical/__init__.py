"""Physically consistent inertias from base parameters."""
