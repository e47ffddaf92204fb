"""Find the effects that the residual asks for, and measure the error before and after."""
