"""Event-camera simulator: events with exact ground truth from a scene and a trajectory, without any recording."""
