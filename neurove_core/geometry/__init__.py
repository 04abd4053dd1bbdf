"""Geometry: rotations, motion (poses and twists), and the camera (lens models and look-up table)."""
