"""Faults injected into jobs, and what is left of the jobs afterwards."""
