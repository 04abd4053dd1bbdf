"""Training: what a network learns from, how it learns, and what is kept of it on the way."""
