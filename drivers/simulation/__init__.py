"""Simulated cell of CiA 402 amplifiers that answers on a real CAN bus."""
