"""Optical flow, tracks, masks, depth and inspection of captures."""
