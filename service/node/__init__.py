"""The service process: build, start, answer queries, watch, stop."""
