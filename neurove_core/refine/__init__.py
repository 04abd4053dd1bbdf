"""Refinement of estimates by the events of each window, after the network."""
