"""Training: sequences, augmentation, the loop, checkpoints, and the calibration of the uncertainty."""
