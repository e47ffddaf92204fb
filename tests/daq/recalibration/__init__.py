"""The scheduled job, in process on a virtual bus with the simulated cell."""
