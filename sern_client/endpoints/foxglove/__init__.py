"""Viewers: Foxglove and Lichtblick."""
