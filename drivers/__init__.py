"""The amplifiers: CANopen/CiA 402 drives, buses, SYNC-grouped streams, and a simulated cell that answers like a real one."""
