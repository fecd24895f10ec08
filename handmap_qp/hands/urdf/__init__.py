"""Changes to URDF text before a model is built: read, check, cut, edit, mount, mirror."""
