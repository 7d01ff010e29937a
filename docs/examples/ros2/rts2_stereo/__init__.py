"""Disparity from a stereo camera, by a network of rts2."""
