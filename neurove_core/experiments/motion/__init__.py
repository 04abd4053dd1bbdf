"""Accuracy by kind of motion: one table with the required value and the goal of every figure."""
