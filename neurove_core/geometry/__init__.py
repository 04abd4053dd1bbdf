"""Rotations, motion (poses and twists), and the camera (lens and look-up table)."""
