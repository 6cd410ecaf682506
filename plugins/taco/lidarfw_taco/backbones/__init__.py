"""Backbones of the plugin."""
