"""What a moving scene of Gaussians may call for, one file each."""
