"""Evaluation of estimates against the ground truth, and contrast maximisation."""
