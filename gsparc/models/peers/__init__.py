"""Published learned methods as `Method`s, trained and stored alike."""
