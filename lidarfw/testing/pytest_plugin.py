"""Fixtures for tests of components (loaded by pytest through its entry point)."""
