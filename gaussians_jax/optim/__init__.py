"""Optimization and density control of Gaussians."""
