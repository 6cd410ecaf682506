"""Necks of the plugin."""
