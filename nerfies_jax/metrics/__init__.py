"""Metrics of quality, time and memory."""
