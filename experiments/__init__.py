"""Runnable studies and the main job: `python -m experiments.NAME`."""

from nerfies_jax import console

# Before anything else can open a file under the number of a closed stream.
console.open_descriptors()
