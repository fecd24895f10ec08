"""From what trackers measure to samples of the human hand."""
