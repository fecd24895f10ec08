"""Live input: sources of human samples, sent to the mapping service or recorded."""
