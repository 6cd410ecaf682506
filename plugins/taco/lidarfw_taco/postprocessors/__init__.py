"""Postprocessors of the plugin."""
