"""What was measured of a human hand: samples, recordings, and a person's lengths."""
