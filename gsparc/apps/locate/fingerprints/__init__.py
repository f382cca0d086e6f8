"""Levels of access points of unknown place: rows, their field, and its likelihood."""
