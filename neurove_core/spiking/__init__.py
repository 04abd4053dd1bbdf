"""Which equation? Neurons, cells, their surrogate gradient; one file for each, with its equation and its source."""
