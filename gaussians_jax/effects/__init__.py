"""Optional components of a scene of Gaussians, one file each."""
