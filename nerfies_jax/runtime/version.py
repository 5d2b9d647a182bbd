"""Version of the distribution, which holds all packages of this repository."""

__version__ = "0.2.0"
