"""The amplifiers: CANopen/CiA 402 drives, buses, SYNC-grouped streams, and a cell simulated on a bus."""
