"""What the simulated camera sees: scenes, panels, textures."""
