"""The path of a packet: registry, worker with its queue, stream, lanes with the models at work."""
