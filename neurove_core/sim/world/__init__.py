"""The simulated world: scenes, panels, textures."""
