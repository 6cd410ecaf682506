"""Presets and experiments."""
