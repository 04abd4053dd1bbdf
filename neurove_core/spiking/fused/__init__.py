"""Compiled forms of the neurons and cells in the folder above."""
