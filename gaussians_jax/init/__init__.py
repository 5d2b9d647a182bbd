"""Initialization of Gaussians from points and from tracks."""
