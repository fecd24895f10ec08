"""A software renderer for hands, without a display."""
