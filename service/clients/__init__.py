"""Clients of a service: queries, camera drivers, recorders."""
