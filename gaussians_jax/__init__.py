"""Moving scenes as 3D Gaussians, splatted in pure JAX.

Reads floors 1-5 of `nerfies_jax` (`geometry`, `nets`, `capture`, `training`,
`measure`) and nothing above them.
"""
