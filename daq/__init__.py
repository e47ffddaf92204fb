"""The service: cell configuration, recording, log, jobs, write-back, report and command line."""
