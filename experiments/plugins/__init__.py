"""Plugins for other frameworks, which find them by entry points (docs/plugins.md)."""
