"""What measurements are in words, and what about them looks wrong."""
