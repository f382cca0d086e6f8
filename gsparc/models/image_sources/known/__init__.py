"""Known walls: mirror images of the static end in them, and what they hide."""
