"""NeuroVE recordings: MCAP files that hold the packets of event streams."""
