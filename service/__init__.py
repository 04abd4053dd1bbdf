"""The long-running process: camera streams in over Zenoh, velocity out."""
