"""Where something was heard: places by the likelihood of a learned field."""
