"""The buses of a cell, their nodes, the objects and the services that reach them (CiA 301)."""
