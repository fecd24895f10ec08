"""Live input: sources of human samples, led to the mapping service or into a file."""
