"""One small file or folder per command."""
