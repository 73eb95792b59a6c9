"""A robot's log: what a chunk is, who writes it, where chunks are kept."""
