"""NeuroVE (paper Fig. 2) and the networks it is compared with."""
