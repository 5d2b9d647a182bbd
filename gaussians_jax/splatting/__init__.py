"""Projection, binning and blending: differentiable rasterization."""
