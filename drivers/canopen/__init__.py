"""One CANopen bus: its nodes, their objects and the services that reach them (CiA 301)."""
