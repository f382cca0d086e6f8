"""Received powers as a field: losses in known walls, and a process of the rest."""
