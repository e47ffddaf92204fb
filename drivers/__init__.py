"""Drive CiA 402 amplifiers over CANopen: find them, stream their samples, move them, and simulate a cell of them."""
