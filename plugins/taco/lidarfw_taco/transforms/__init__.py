"""Transforms of the plugin."""
