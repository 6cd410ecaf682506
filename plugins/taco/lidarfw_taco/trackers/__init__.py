"""Trackers of the plugin."""
