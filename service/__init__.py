"""The long-running service: event streams in over Zenoh, velocity out."""
