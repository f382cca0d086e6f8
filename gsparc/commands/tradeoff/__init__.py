"""Accuracy against latency of a trained model: sweep its reductions, draw the front, keep it."""
