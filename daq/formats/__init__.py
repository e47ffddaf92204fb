"""Controller files by format: find the gains, replace them, keep every other byte."""
