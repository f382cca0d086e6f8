"""What trades accuracy for time when a trained model answers: sweep it, draw it, keep it, choose from it."""
