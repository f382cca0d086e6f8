"""A model's answers over HTTP (extra `serve`)."""
