"""Recordings in HDF5: MVSEC, DSEC, M3ED, Prophesee and others."""
