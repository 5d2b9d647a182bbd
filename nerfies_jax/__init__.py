"""Radiance fields of moving scenes, and the ground both representations share.

Floors 1-5 (`geometry`, `nets`, `capture`, `training`, `measure`) hold what every
reconstruction needs: cameras, small networks, captures, the scanned training loop,
metrics. `gaussians_jax` reads those floors and nothing above them. A room reads only
rooms on lower floors.
"""
