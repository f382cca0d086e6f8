"""Runs: what one begins with, its folder and lock, the runner of many, what is done already."""
