"""Mixtures of 3D Gaussians, the cameras that see them, and the state that holds them between images."""
