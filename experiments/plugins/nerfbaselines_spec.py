"""Registers `nerfies-jax` with nerfbaselines, which loads this module on its own."""

from nerfbaselines import register

register(
    {
        "id": "nerfies-jax",
        "method_class": "experiments.plugins.nerfbaselines_method:NerfiesJax",
        "backends_order": ["python"],
        "presets": {
            "small": {"@description": "For a CPU.", "preset": "splats-static-small"},
            "mcmc": {"preset": "splats-mcmc"},
            "nerf": {"preset": "nerf"},
            "nerf-small": {"preset": "nerf-small"},
        },
        "metadata": {
            "name": "nerfies-jax",
            "description": "Gaussian splatting and NeRF in JAX.",
            "licenses": [{"name": "Apache-2.0"}],
        },
    }
)
