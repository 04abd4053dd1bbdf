"""The paper (NeuroVE) and its models: no network, no clocks, no threads."""
