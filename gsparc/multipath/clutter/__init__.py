"""What blocks paths and where mirrors end: learned once, shared by all sources."""
