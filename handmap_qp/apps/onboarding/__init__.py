"""A hand of one's own: from any URDF to a `hand.yaml`, and a look at whether it is right."""
