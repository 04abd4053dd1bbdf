"""Live sources: cameras at this machine and network streams, read as their events come."""
