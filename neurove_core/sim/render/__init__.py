"""Cameras, rendering and pixels: from a scene and a pose to events."""
