"""Many captures: one process a run, on this machine, Dask or Slurm."""
