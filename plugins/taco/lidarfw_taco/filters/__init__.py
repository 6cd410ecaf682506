"""Filters of the plugin."""
