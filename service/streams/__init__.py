"""A packet's path: queue, worker, stream, models at work."""
