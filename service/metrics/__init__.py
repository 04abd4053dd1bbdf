"""Metrics for Prometheus, and liveness, readiness and health by HTTP; nothing runs unless a client asks."""
