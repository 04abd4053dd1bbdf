"""Trajectories of the simulated camera."""
