"""The velocity experiment, the paper's Tables III and IV: velocity estimates of all methods."""
