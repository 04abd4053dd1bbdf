"""NeuroVE (paper Fig. 2) and the networks it is compared with; see kinds.py.

The networks import the neurons of `spiking` and nothing of `engine`, the fast path.
"""
