"""How the simulated camera moves."""
