"""What is done with a trained model: asking about places, timing, confidence, faster versions."""
