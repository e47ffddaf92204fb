"""The dictionary of effects that a declared model may lack."""
