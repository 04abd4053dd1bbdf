"""From a scene and a pose to events: rendering, the camera, the pixels."""
