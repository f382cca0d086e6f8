"""Clutter: occluding boxes and finite mirrors, shared by all sources."""
