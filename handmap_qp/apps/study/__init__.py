"""Results of a user study of two mappings: `handmap study`."""
