"""A packet's bytes to complete windows of event counts."""
