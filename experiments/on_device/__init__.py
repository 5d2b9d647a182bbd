"""Tests and timings on an accelerator."""
