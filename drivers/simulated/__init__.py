"""A cell of CiA 402 amplifiers with a physical plant behind them, answering on a real bus; usable alone."""
