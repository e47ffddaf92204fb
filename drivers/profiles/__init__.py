"""Objects, units and states of an amplifier (CiA 402 and the makers' own)."""
