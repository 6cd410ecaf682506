"""Presets and experiments of lidarfw-dpdc-mos."""
