"""Heads of the plugin."""
