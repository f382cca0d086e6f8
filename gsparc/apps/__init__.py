"""What is done with predictions: nothing else of gsparc but the commands knows these."""
