"""Our own recordings: MCAP files that hold the packets of a stream."""
