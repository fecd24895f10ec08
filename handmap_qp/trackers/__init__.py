"""From files and devices to samples of a human hand, and checks that they are what they say."""
