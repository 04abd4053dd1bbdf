"""The paper's Tables III and IV: velocity by all methods."""
