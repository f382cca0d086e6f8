"""Confidences compared by risk against coverage, and thresholds whose risk is bounded."""
