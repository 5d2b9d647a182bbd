"""Arrays of Gaussians, and the protocols of the parts of a scene."""
