"""A gyroscope in addition to the events: angular velocity, its bias, rest, and the check of one against the other."""
