"""Tests of the live console."""
