"""The sine experiment, the paper's Tables I and II: regression and forecast of sine waves."""
