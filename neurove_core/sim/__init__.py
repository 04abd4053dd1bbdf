"""Event-camera simulator: scene and trajectory -> events with exact truth, without any recording."""
