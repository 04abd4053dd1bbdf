"""Evaluation of estimates against the truth, and contrast maximisation."""
