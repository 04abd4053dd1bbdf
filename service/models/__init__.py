"""The models of a node: which one serves, and how it changes."""
