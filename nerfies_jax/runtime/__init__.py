"""Contracts, messages, events, signals and processes."""
