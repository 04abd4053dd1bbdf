"""What talks to a service: queries, camera drivers, recorders."""
