"""Static radiance fields: sampling, networks and volume rendering."""
